"""From evaluation episodes to confidence intervals and summaries of arms.

Summaries are queries of the long table that `episodes` makes of results, which needs the extra "train"; `statistics`
does not: `ncs attack` runs without it.
"""
