"""Compiled loops of `SpeedTracking`."""

from __future__ import annotations

from ncs_gym.compiled import entry


@entry
def follow_profile(memory, acceleration, dt, draws, change_probability, fastest, out):
    """Fills speeds and targets, shape (N, 2), one step after `memory`; see `SpeedTracking.advance`."""
    for e in range(out.shape[0]):
        out[e, 0] = memory[e, 0] + dt * acceleration[e]
        out[e, 1] = fastest * draws[1, e] if draws[0, e] < change_probability else memory[e, 1]


@entry
def profile_reward(memory, acceleration, error_weight, input_weight, out):
    """Fills rewards, shape (N,); see `SpeedTracking.reward`."""
    for e in range(out.size):
        error, effort = memory[e, 1] - memory[e, 0], acceleration[e]
        out[e] = -error_weight * min(abs(error) / 5.0, 5.0) - input_weight * effort * effort
