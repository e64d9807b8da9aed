"""The unit of work: one training run, the setup it takes place in, and its stored result."""
