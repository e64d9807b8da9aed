"""What the shield is compared with: filters that take the estimate for the truth, and linear controllers.

None of them comes with a proof under estimation errors, so none reports `shield_guaranteed`.
"""

from experiments.baselines.controllers import CONTROLLERS, REGULATORS, controller
from experiments.baselines.estimate_filter import FILTERS, EstimateFilter, EstimateFilterSettings
from experiments.baselines.margins import MARGINS
from experiments.baselines.regulators import RegulatorWeights
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
]
