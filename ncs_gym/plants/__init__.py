"""Plants: what is controlled, with its limits and the hard bounds on everything uncertain about it."""
