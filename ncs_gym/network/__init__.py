"""The network between sensor and controller, and between controller and actuator.

`channel` has the settings, `packet_loss_and_delay` what happens to packets during an episode, `contract` what a channel
promises; `downlink` is the way of the commands, `actuator` their end; `packet_log` is a record of packets.
"""
