"""The Monte Carlo campaign behind `ncs certify`: worst-case disturbances and hostile agents against shielded loops."""
