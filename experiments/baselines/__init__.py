"""What the shield is compared with: filters that take the estimate for the truth, and linear controllers.

None of them comes with a proof under estimation errors, so none reports `shield_guaranteed`.
"""

from experiments.baselines.controllers import CONTROLLERS, REGULATORS, RegulatorWeights, controller, why_aimless
from experiments.baselines.filters import FILTERS, MARGINS, EstimateFilter, EstimateFilterSettings
from experiments.baselines.tuned import tuned_training, tuned_weights

__all__ = [
    "CONTROLLERS",
    "FILTERS",
    "MARGINS",
    "REGULATORS",
    "EstimateFilter",
    "EstimateFilterSettings",
    "RegulatorWeights",
    "controller",
    "tuned_training",
    "tuned_weights",
    "why_aimless",
]
