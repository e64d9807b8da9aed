"""From evaluation episodes, a long table, to confidence intervals and summaries of arms."""
