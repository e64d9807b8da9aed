"""The command line, and everything that makes tables and figures."""

__distribution__ = "ncs-gym"
