"""The network between sensor and controller: what it does to packets, and what it guarantees."""
