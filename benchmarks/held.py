"""What can be held near a limit behind a shield: `python -m benchmarks.held COMMAND`.

Commands: windup.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import matplotlib
import numpy as np

from benchmarks.commands import run, table
from experiments.figures import STYLE, CaptionedFigure, label, legend_below
from ncs_gym import LinearPlant, NCSEnv, NCSVectorEnv
from ncs_gym.envs.env import ncs_env
from ncs_gym.plants.lqr import lqr_gain
from shields import VectorSafetyShield, certificate_for, setpoint_range

# The environment, and the state whose high limit is exceeded by the set point.
_ID, _STATE = "ncs_gym/TruckTrailerCruise-v0", 0
# Weight of the integral against that of the state, in units of its limit.
_INTEGRAL = 0.003
# Steps of the figure, between which its set point is beyond what can be held.
_SHOWN, _FROM, _TO = 400, 50, 200


class IntegralController:
    """An LQR of states and integral, u = K x_hat + k z with z+ = z + r - x_i, where x_i is to be at a set point r.

    Args:
        plant: The plant.
        fed_back: Whether the integral follows what was applied: z is what gives that input.
    """

    def __init__(self, plant: LinearPlant, fed_back: bool) -> None:
        n, m = plant.n, plant.m
        A, B = np.eye(n + 1), np.vstack([plant.B, np.zeros((1, m))])
        A[:n, :n], A[n, _STATE] = plant.A, -1.0
        widths = np.append(plant.half_widths, plant.half_widths[_STATE] / _INTEGRAL**0.5)
        gain = lqr_gain(A, B, np.diag(widths**-2.0), np.diag(plant.input_half**-2.0))
        assert gain is not None
        self._K, self._k, self._fed_back = gain[:, :n], gain[:, n:], fed_back
        self._back, self._z = np.linalg.pinv(self._k), np.zeros((1, 1))

    def propose(self, estimates: np.ndarray) -> np.ndarray:
        """Returns inputs, shape (N, m), for estimates, shape (N, n)."""
        self._proposed = estimates @ self._K.T + self._z @ self._k.T
        return self._proposed

    def follow(self, estimates: np.ndarray, applied: np.ndarray, r: float) -> None:
        """Takes in what was applied, shape (N, m), and moves the integral."""
        if self._fed_back:
            self._z = self._z + (applied - self._proposed) @ self._back.T
        self._z = self._z + r - estimates[:, [_STATE]]


def simulated(env: NCSEnv, controller: IntegralController, set_points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the state of interest and whether inputs were overridden, shape (steps,) each, for set points."""
    plant, states, overridden = env.plant, [], []
    loop = NCSVectorEnv(1, plant=plant, channel=env.channel, contract=env.contract)
    shield = VectorSafetyShield(loop, certificate_for(plant, env.certificate_contract), on_unproved="ignore")
    _, info = shield.reset(seed=0, options={"state": np.zeros((1, plant.n))})
    for r in set_points:
        estimates = info["estimate"]
        action = (controller.propose(estimates) - plant.input_middle) / plant.input_half
        *_, info = shield.step(np.clip(action, -1.0, 1.0).astype(np.float32))
        controller.follow(estimates, info["input"], float(r))
        states.append(info["state"][0, _STATE])
        overridden.append(info["shield_intervened"][0])
    shield.close()
    return np.array(states), np.array(overridden)


def windup(out: Path | None = None) -> None:
    """An integral behind the shield that follows the input applied, and one that does not, drawn with --out.

    The set point is 1.5 times the limit for 150 steps, more than can be held, and the operating point before and after.
    The table says how many steps later the state is back for good, within a tenth of the limit, and how many steps were
    overridden.
    """
    env = ncs_env(gym.make(_ID))
    limit = float(env.plant.own_limits[1, _STATE])
    set_points = np.where((np.arange(_SHOWN) >= _FROM) & (np.arange(_SHOWN) < _TO), 1.5 * limit, 0.0)
    show, drawn = table(_ID, "back after", "overridden", first=32), {}
    for text, fed_back in {"decision.input fed back": True, "without": False}.items():
        drawn[text], overridden = simulated(env, IntegralController(env.plant, fed_back), set_points)
        away = np.flatnonzero(np.abs(drawn[text]) > 0.1 * limit)
        back = f"{away[-1] + 1 - _TO} steps" if away[-1] + 1 < _SHOWN else "-"
        show(text, back, f"{overridden.mean():.1%}")
    if out is not None:
        out.write_bytes(_drawn(env, set_points, drawn).png)


def _drawn(env: NCSEnv, set_points: np.ndarray, drawn: dict[str, np.ndarray]) -> CaptionedFigure:
    plant, times = env.plant, env.plant.dt * np.arange(1, _SHOWN + 1)
    points = setpoint_range(certificate_for(plant, env.certificate_contract), plant, _STATE)
    assert points is not None
    with matplotlib.rc_context(STYLE):
        figure = CaptionedFigure((8.0, 3.4))
        axis = figure.subplots()
        axis.axhline(plant.own_limits[1, _STATE], color="#555555", linewidth=1.0, label="limit")
        axis.axhspan(*points.deviations, color="#009e73", alpha=0.12, label="setpoint_range")
        axis.step(times, set_points, where="post", color="#999999", linestyle=":", label="set point")
        for (text, values), color in zip(drawn.items(), ("#0072b2", "#d55e00"), strict=True):
            axis.plot(times, values, color=color, label=text)
        axis.set(xlim=(0.0, times[-1]), ylim=np.array([-0.2, 1.6]) * plant.own_limits[1, _STATE])
        label(axis, "time [s]", f"{plant.state_names[_STATE]} [{plant.state_units[_STATE]}]")
        legend_below(figure, dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True)))
    return figure


COMMANDS = (windup,)

if __name__ == "__main__":
    run(__doc__, COMMANDS)
