"""`ncs loop`: a simulated plant, a bad network and a controller as processes that talk in datagrams, in real time."""
