"""What a shield adds where its inputs take effect some steps later (docs/contracts.md, "Both directions").

`schedule` checks that what was decided is applied when its step comes; what is known of the states before the first
decision takes effect is in `shields.runtime.starts`.
"""

from shields.downlink.schedule import as_decided

__all__ = ["as_decided"]
