"""What a shield adds where its inputs take effect some steps later (docs/contracts.md, "Both directions").

`first_steps` shows the states before the first decision takes effect to be safe, `schedule` checks that what was
decided is applied when its step comes.
"""

from shields.downlink.first_steps import first_observations, known_inside, starts_known
from shields.downlink.schedule import Schedule, VectorSchedule, as_decided

__all__ = ["Schedule", "VectorSchedule", "as_decided", "first_observations", "known_inside", "starts_known"]
