"""Where runs are executed: worker processes of this machine, or a Ray cluster; results do not depend on it.

The modules of the backends are imported where they are used, so that a worker process that only imports
`initialize_worker` starts at once.
"""

from experiments.backends.worker_init import initialize_worker

__all__ = ["initialize_worker"]
