"""What can be held near a limit behind a shield: `python -m benchmarks.held COMMAND`.

Commands: limits, windup.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np

from benchmarks.commands import run, table
from benchmarks.published import certified, channel_of, contract_of_plant, plant_of
from experiments.plots.figure_style import STYLE, CaptionedFigure, label, legend_below
from ncs_gym import LinearPlant, NCSVectorEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.plants.lqr import lqr_gain
from shields import Certificate, VectorSafetyShield, certificate_for, setpoint_range

# Plants by name, with the state whose high limit the controller is told to hold.
HELD = {
    "TruckTrailerCruise-v0": 0,
    "CartPole-v0": 0,
    "CSTR-v0": 1,
    "Pendulum-v0": 0,
    "boost": 1,
    "bicycle": 0,
}
# Weight of the integral against that of the state, in units of its limit.
_INTEGRAL = 0.003
_LOOPS, _STEPS = 16, 1_500
# Steps of the figure, between which its set point is beyond what can be held.
_WINDING, _SHOWN, _FROM, _TO = "TruckTrailerCruise-v0", 400, 50, 200


class Setting(NamedTuple):
    """A plant with its certificate, and what its environments are made with."""

    plant: LinearPlant
    certificate: Certificate
    settings: dict[str, Any]


def setting_of(name: str) -> Setting:
    """Returns the setting of a registered environment, or of a published plant."""
    if name.endswith("-v0"):
        env = ncs_env(gym.make(f"ncs_gym/{name}"))
        settings = {"plant": env.plant, "channel": env.channel, "contract": env.contract}
        return Setting(env.plant, certificate_for(env.plant, env.certificate_contract), settings)
    plant = plant_of(name)
    settings = {"plant": plant, "channel": channel_of(name), "contract": contract_of_plant(name)}
    return Setting(plant, certified(name, plant), settings)


class IntegralController:
    """An LQR of states and integral, u = K x_hat + k z with z+ = z + r - x_i, for many loops.

    Args:
        plant: The plant.
        state: i, the state that is to be at a set point r.
        fed_back: Whether the integral follows what was applied: z is what gives that input.
    """

    def __init__(self, plant: LinearPlant, state: int, fed_back: bool = True) -> None:
        n, m = plant.n, plant.m
        A, B = np.eye(n + 1), np.vstack([plant.B, np.zeros((1, m))])
        A[:n, :n], A[n, state] = plant.A, -1.0
        widths = np.append(plant.half_widths, plant.half_widths[state] / _INTEGRAL**0.5)
        gain = lqr_gain(A, B, np.diag(widths**-2.0), np.diag(plant.input_half**-2.0))
        assert gain is not None
        self._K, self._k, self._state, self._fed_back = gain[:, :n], gain[:, n:], state, fed_back
        self._back, self._z = np.linalg.pinv(self._k), np.zeros((1, 1))

    def propose(self, estimates: np.ndarray) -> np.ndarray:
        """Returns inputs, shape (N, m), for estimates, shape (N, n)."""
        self._proposed = estimates @ self._K.T + self._z @ self._k.T
        return self._proposed

    def follow(self, estimates: np.ndarray, applied: np.ndarray, r: float) -> None:
        """Takes in what was applied, shape (N, m), and moves the integral."""
        if self._fed_back:
            self._z = self._z + (applied - self._proposed) @ self._back.T
        self._z = self._z + r - estimates[:, [self._state]]


def simulated(setting: Setting, controller: IntegralController, set_points: np.ndarray, loops: int) -> dict[str, Any]:
    """Returns states, shape (steps, N, n), and whether inputs were overridden, (steps, N), for a set point per step."""
    plant, states, overridden = setting.plant, [], []
    shield = VectorSafetyShield(NCSVectorEnv(loops, **setting.settings), setting.certificate, on_unproved="ignore")
    _, info = shield.reset(seed=0, options={"state": np.zeros((loops, plant.n))})
    for r in set_points:
        estimates = info["estimate"]
        action = (controller.propose(estimates) - plant.input_middle) / plant.input_half
        *_, info = shield.step(np.clip(action, -1.0, 1.0).astype(np.float32))
        controller.follow(estimates, info["input"], float(r))
        states.append(info["state"])
        overridden.append(info["shield_intervened"])
    shield.close()
    return {"states": np.array(states), "overridden": np.array(overridden)}


def limits() -> None:
    """How far a limit is held by an LQR with integral that is told to rest at it, beside `shields.setpoint_range`.

    All as shares of the way from the operating point to the limit. "held" is the mean of the second half of 16 episodes
    of 1,500 steps with random disturbances over the plant's network, "most" the largest state then, "overridden" the
    share of its steps; "fresh" and "oldest" are the ends of the range with samples of age 0 and of the oldest age.
    """
    show = table("plant", "limit", "held", "most", "overridden", "fresh", "oldest", first=42, width=8)
    for name, state in HELD.items():
        setting = setting_of(name)
        plant, certificate = setting.plant, setting.certificate
        limit = float(plant.own_limits[1, state])
        found = simulated(setting, IntegralController(plant, state), np.full(_STEPS, limit), _LOOPS)
        late = found["states"][_STEPS // 2 :, :, state] / limit
        ranges = [setpoint_range(certificate, plant, state, age) for age in (0, len(certificate.proofs) - 1)]
        ends = ["none" if each is None else f"{each.deviations[1] / limit:.3f}" for each in ranges]
        high = f"{limit + plant.operating_state[state]:.4g} {plant.state_units[state]}".rstrip()
        overridden = found["overridden"][_STEPS // 2 :].mean()
        held = f"{late.mean():.3f}", f"{late.max():.3f}", f"{overridden:.1%}"
        show(f"{name}, {plant.state_names[state]}", high, *held, *ends)


def windup(name: str = _WINDING, out: Path | None = None) -> None:
    """An integral behind the shield that follows the input applied, and one that does not, drawn with --out.

    The set point is 1.5 times the limit for 150 steps, more than can be held, and the operating point before and after.
    The table says how many steps later the state is back for good, within a tenth of the limit, and how many steps were
    overridden.
    """
    setting, state = setting_of(name), HELD[name]
    limit = float(setting.plant.own_limits[1, state])
    set_points = np.where((np.arange(_SHOWN) >= _FROM) & (np.arange(_SHOWN) < _TO), 1.5 * limit, 0.0)
    show, drawn = table(name, "back after", "overridden", first=28), {}
    for text, fed_back in {"decision.input fed back": True, "without": False}.items():
        found = simulated(setting, IntegralController(setting.plant, state, fed_back), set_points, 1)
        drawn[text] = found["states"][:, 0, state]
        away = np.flatnonzero(np.abs(drawn[text]) > 0.1 * limit)
        back = f"{away[-1] + 1 - _TO} steps" if away[-1] + 1 < _SHOWN else "-"
        show(text, back, f"{found['overridden'].mean():.1%}")
    if out is not None:
        out.write_bytes(_windup_drawn(setting, state, set_points, drawn).png)


def _windup_drawn(
    setting: Setting, state: int, set_points: np.ndarray, drawn: dict[str, np.ndarray]
) -> CaptionedFigure:
    plant, times = setting.plant, setting.plant.dt * np.arange(1, _SHOWN + 1)
    points = setpoint_range(setting.certificate, plant, state)
    assert points is not None
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((8.0, 3.4))
        axis = figure.subplots()
        axis.axhline(plant.own_limits[1, state], color="#555555", linewidth=1.0, label="limit")
        axis.axhspan(*points.deviations, color="#009e73", alpha=0.12, label="setpoint_range")
        axis.step(times, set_points, where="post", color="#999999", linestyle=":", label="set point")
        for (text, values), color in zip(drawn.items(), ("#0072b2", "#d55e00"), strict=True):
            axis.plot(times, values, color=color, label=text)
        axis.set(xlim=(0.0, times[-1]), ylim=np.array([-0.2, 1.6]) * plant.own_limits[1, state])
        label(axis, "time [s]", f"{plant.state_names[state]} [{plant.state_units[state]}]")
        legend_below(figure, dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True)))
    return figure


COMMANDS = (limits, windup)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
