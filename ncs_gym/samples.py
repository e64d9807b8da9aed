"""Compiled loops that measure, lose, delay and round samples; the last axis of every array is the environment."""

from __future__ import annotations

import numpy as np

from ncs_gym.compiled import inner
from ncs_gym.draws import fill_uniform
from ncs_gym.law import add_drawn
from ncs_gym.product import set_product

# Counts never get here.
MOST = 1 << 40
# Rows of uniform draws: whether a packet is lost, its jitter, and the chain.
LOSS, JITTER, CHAIN = range(3)


@inner
def send(system, fleet, tick, number, network):
    """Measures, rounds, loses and delays the samples of this step.

    Args:
        system: The loop.
        fleet: Changed in place.
        tick: Steps of the whole fleet.
        number: Of the first draw of the sensors.
        network: Of the first draw of the channel.
    """
    slot, law = tick % system.slots, system.sensor
    if not _some_send(fleet.due, slot, fleet.wait):
        return
    fill_uniform(fleet.keys, network, min(system.uniforms, CHAIN), fleet.uniforms)
    fleet.noise.fill(0.0)
    add_drawn(law.kind, law.factor, law.energy, fleet.keys, number, fleet.noise)
    _lose(system.losses, system.most_lost, fleet.uniforms, fleet.wait, fleet.bad, fleet.lost, fleet.due[slot])
    _delay(system.period, system.delay, system.jitter, fleet.uniforms, fleet.wait, fleet.due[slot])
    _measure(system.H, fleet.state, fleet.noise, fleet.samples[slot])
    _round(system.step, fleet.samples[slot], fleet.due[slot], fleet.alarm)


@inner
def switch(moves, draws, bad):
    """Moves the chain of the channel."""
    for e in range(bad.size):
        bad[e] ^= draws[CHAIN, e] < moves[bad[e]]


@inner
def _some_send(due, slot, wait):
    """Marks that nothing was sent at this step, and returns whether something is to be."""
    sent = 0
    for e in range(wait.size):
        due[slot, e] = -1
        sent += wait[e] <= 0
    return sent > 0


@inner
def _lose(losses, most_lost, draws, wait, bad, in_a_row, due):
    """Fills -1 where no sample is sent or it is lost, else 0, shape (N,), and counts losses in a row."""
    good_loss, bad_loss = losses[0], losses[1]
    most = most_lost if most_lost >= 0 else MOST
    for e in range(due.size):
        lost = draws[LOSS, e] < (bad_loss if bad[e] else good_loss)
        due[e] = -1 if lost & (in_a_row[e] < most) else 0
    for e in range(due.size):
        in_a_row[e] = in_a_row[e] if wait[e] > 0 else -due[e] * (in_a_row[e] + 1)
    for e in range(due.size):
        due[e] = -1 if wait[e] > 0 else due[e]


@inner
def _delay(period, delay, jitter, draws, wait, due):
    """Adds the age of arrival where a sample is sent, shape (N,), and sets the time until the next one."""
    if jitter > 0:
        for e in range(due.size):
            extra = np.int32(draws[JITTER, e] * (jitter + 1))
            due[e] += min(extra, jitter) if due[e] >= 0 else 0
    for e in range(due.size):
        due[e] += delay if due[e] >= 0 else 0
    for e in range(due.size):
        wait[e] = wait[e] if wait[e] > 0 else period


@inner
def _measure(H, state, noise, samples):
    """Fills H x + noise, shape (p, N)."""
    set_product(H, state, samples)
    for i in range(samples.shape[0]):
        for e in range(samples.shape[1]):
            samples[i, e] += noise[i, e]


@inner
def _round(step, samples, due, alarm):
    """Rounds samples, shape (p, N); what is not finite is not sent and raises the alarm."""
    absurd = 0
    for i in range(samples.shape[0]):
        for e in range(samples.shape[1]):
            absurd += not np.isfinite(samples[i, e])
    if absurd > 0:
        for i in range(samples.shape[0]):
            for e in range(samples.shape[1]):
                if not np.isfinite(samples[i, e]):
                    samples[i, e] = 0.0
                    if due[e] >= 0:  # no sensor within the assumptions sends this
                        due[e], alarm[e] = -1, 1
    if step > 0.0:
        for i in range(samples.shape[0]):
            for e in range(samples.shape[1]):
                samples[i, e] = np.rint(samples[i, e] / step) * step
