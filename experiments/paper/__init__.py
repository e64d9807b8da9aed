"""Liu et al. by their own numbers: the printed example, the audit of the claims, and Section 5 simulated.

`audit` lists the claims; `counterexample` looks for steps that leave a set and confirms them in exact arithmetic, and
`late_packets` has the filter of the paper, which the rest of this project does not use.
"""

from experiments.paper.paper_example import PaperExample

__all__ = ["PaperExample"]
