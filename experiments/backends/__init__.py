"""Where runs are executed: worker processes of this machine, or a Ray cluster; results do not depend on it.

The modules of the backends are imported where they are used, so that a worker process starts at once.
"""
