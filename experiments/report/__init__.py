"""The pages of comparisons, sweeps and studies: templates, and what is inserted into them."""
