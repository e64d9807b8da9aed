"""From evaluation episodes to intervals, summaries and tables."""
