"""The commands of `ncs`, one module each: its settings, then a function of them that writes its files.

What they raise is a sentence for the user: ValueError for settings that cannot be, `RunError`, `shields.Infeasible` and
`CertificateError`, `agents.AgentError`, and OSError.
"""
