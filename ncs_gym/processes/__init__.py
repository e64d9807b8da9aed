"""What really moves: the equations of the linear plant, of a member of its family, a function, or other environments.

The certified model stays a linear plant (`linear_model` finds one); what a process does beyond it has to lie in the
plant's disturbance bound.
"""
