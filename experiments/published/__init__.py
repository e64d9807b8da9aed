"""Plants with the limits that their authors published: what of them a certificate keeps (docs/published_plants.md)."""
