"""What the shield is compared with: filters that take the estimate for the truth, and linear controllers.

None of them comes with a proof under estimation errors, so none reports `shield_guaranteed`.
"""
