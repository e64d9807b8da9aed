"""From evaluation episodes to confidence intervals, summaries of arms, and tables.

Summaries are queries of the long table that `episodes` makes of results. These two modules need the extra "train", the
others do not: `ncs attack` runs without it.
"""
