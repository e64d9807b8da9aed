"""Where training runs are executed: worker processes of this machine, or a Ray cluster."""
