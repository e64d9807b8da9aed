"""What a shield adds where its inputs take effect some steps later (docs/contracts.md, "Both directions").

`start_under_zero_input` shows the states before the first decision takes effect to be safe, `schedule` checks that what
was decided is applied when its step comes.
"""

from shields.downlink.schedule import as_decided
from shields.downlink.start_under_zero_input import first_observations, known_inside, starts_known

__all__ = ["as_decided", "first_observations", "known_inside", "starts_known"]
