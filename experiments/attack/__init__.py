"""The Monte Carlo campaign behind `ncs attack`: worst-case disturbances and hostile agents against shielded loops."""
