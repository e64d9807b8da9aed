"""Compiled loops of tasks whose targets are random and piecewise constant."""

from __future__ import annotations

from ncs_gym.compiled import entry


@entry
def follow_targets(targets, draws, change_probability, reach, out):
    """Fills targets, shape (N, 1), one step after `targets`; see `SetpointTracking.advance`."""
    for e in range(out.shape[0]):
        out[e, 0] = reach * (2.0 * draws[1, e] - 1.0) if draws[0, e] < change_probability else targets[e, 0]


@entry
def target_reward(targets, states, output, width, out):
    """Fills rewards, shape (N,), for states (N, n); see `SetpointTracking.reward`."""
    for e in range(out.size):
        out[e] = -targets[e, 0]
    for i in range(output.size):
        share = output[i]
        for e in range(out.size):
            out[e] += share * states[e, i]
    for e in range(out.size):
        out[e] = 1.0 - min(abs(out[e]) / width, 1.0)


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
