"""The unit of work: a training run, the control loop it takes place in, and its output folder."""
