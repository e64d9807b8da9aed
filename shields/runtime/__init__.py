"""The shield at run time: the one-step test, the decision, the guarantee monitor and the wrappers."""
