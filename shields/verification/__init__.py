"""Exact verification of certificates in rational arithmetic: no solver, no tolerance."""
