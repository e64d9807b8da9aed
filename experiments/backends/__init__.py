"""Where runs are executed: worker processes of this machine, or a Ray cluster; results do not depend on it."""
