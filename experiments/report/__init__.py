"""The HTML report of a comparison or a sweep: one page that opens offline."""
