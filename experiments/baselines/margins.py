"""The margins that filters and governors of the estimate are given."""

# Of the box and the safe set, in percent.
MARGINS = (5, 10, 20, 40)
