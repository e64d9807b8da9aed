"""The network between sensor and controller, and between controller and actuator.

`channel` has the settings (packet loss, quantization, transmission period, delay and jitter), `packet_loss_and_delay`
what happens to packets during an episode, `contract` what a channel guarantees about the age of samples,
`packet_reception` which packets a receiver can use, and `gaussian_bound` says how likely Gaussian noise is to leave its
bounds, given how many samples a channel takes. `packet_log` is a record of packets, whose ages a `TraceChannel`
replays, and `log_files` reads it from files.
`downlink` is the way of the commands during an episode, `actuator` what commands and echoes hold, and what is applied.
"""
