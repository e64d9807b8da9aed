"""The printed numbers of Liu et al. Section 5: their audit, and a reproduction of the simulation."""
