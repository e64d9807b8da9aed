"""The network between sensor and controller, and between controller and actuator.

`channel` has the settings and what a channel promises, `packet_loss_and_delay` what happens to packets during an
episode; `requests` are samples asked for; `downlink` is the way of the commands, with the actuator at its end;
`packet_log` is a record of packets.
"""
