"""The results as a reader sees them: tables on a terminal, and pages with their templates."""
