"""`ncs attack`: worst-case disturbances and agents against the shielded loops of registered environments."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from experiments.runs.loops import registered_env
from experiments.runs.output_folder import require_place, write_json
from experiments.settings import id_alone, require_horizon, require_limits
from experiments.terminal import progress_bar, say, text_table, wrapped
from ncs_gym import AdversarialDisturbance, Channel, ChannelContract, LinearPlant
from ncs_gym.registration import EPISODE_STEPS, registered_ids
from ncs_gym.validation import counted
from shields import Certificate, VectorSafetyShield, certificate_for
from shields.polytope import Polytope
from shields.runtime.safety_filter import Mode


@dataclass(frozen=True, kw_only=True)
class AttackSettings:
    """Attacks shielded loops with worst-case disturbances and agents, and counts states outside.

    Outside are states beyond the safe set or the safe box. Every environment is attacked on its own channel and on
    those that use its contract up. Disturbances push the next state farthest out, first errors and sensor noise have
    full size, and agents are random or hostile. Ends with exit code 1 if a guaranteed state is outside.

    Attributes:
        env: Id of the only environment to attack, or module:id; by default all registered ones.
        steps: Simulated steps in all, at least 8 episodes of each environment and channel.
        mode: Mode of the shield; "monitor" only watches. In mode lookahead states may leave the safe set.
        safe_set: What the shields keep; by default the polytope, where there is one.
        horizon: Longest plan of mode "lookahead" [steps]; 6 by default.
        out: File for the counts (JSON).
        seed: Seed of the attack, >= 0.
    """

    env: str | None = None
    steps: int = 1_000_000
    mode: Mode = "project"
    safe_set: Literal["polytope", "ellipsoid"] | None = None
    horizon: int | None = None
    out: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        require_limits(self, steps=1, seed=0)
        require_horizon(self, self.mode)


# Episodes of a batch, at least and at most.
_FEWEST, _MOST = 8, 1024
# Starts are pulled in: by more than rounding, and behind a downlink, whose first inputs are zero, well into the set.
_INWARD, _BEHIND_DOWNLINK = 1.0 - 1e-9, 0.3
_LEGEND = (
    "blackout: no packet at all",
    "late: the oldest sample that the contract allows, at every step",
    "rare: the longest gap that the contract allows, every time",
    "outside S, outside box: steps with a true state there",
    "no claim: steps that the shield did not guarantee",
    "overridden: steps that the shield changed, in mode monitor would have changed",
)


def attack(settings: AttackSettings) -> None:
    """Runs `ncs attack`; ends with exit code 1 if a guaranteed state was outside, or a guarantee was lost."""
    require_place(settings.out)
    envs = {each: registered_env(each) for each in ([settings.env] if settings.env else registered_ids())}
    channels = {env_id: channels_of(env.channel, env.contract) for env_id, env in envs.items()}
    cases = [(env_id, kind, channel) for env_id in envs for kind, channel in channels[env_id].items()]
    each = max(-(-settings.steps // (len(cases) * EPISODE_STEPS)), _FEWEST)
    rows, failed = {}, Counter[str]()
    with progress_bar(len(cases) * each * EPISODE_STEPS, "attack") as bar:
        for number, (env_id, kind, channel) in enumerate(cases):
            env = envs[env_id]
            certificate = certificate_for(env.plant, env.certificate_contract, settings.safe_set)
            counts, rng = Counter[str](), np.random.default_rng([settings.seed, number])
            for first in range(0, each, _MOST):
                worst = worst_case(certificate, settings.mode)
                vector = gym.make_vec(id_alone(env_id), num_envs=min(_MOST, each - first), channel=channel, **worst)
                mode, horizon = settings.mode, settings.horizon
                shield = VectorSafetyShield(vector, certificate, mode, horizon=horizon, on_unproved="ignore")
                for found in attacked(shield, rng):
                    counts.update(found)
                    bar.update(found["steps"])
                shield.close()
            rows[f"{id_alone(env_id).removeprefix('ncs_gym/')}, {kind}"] = counts
            failed.update(counts)
    print(table_of(rows))
    write_json(settings.out, rows)
    wrong = {"outside the box": failed["guaranteed outside box"]}
    if settings.mode != "lookahead":
        wrong["outside S"] = failed["guaranteed outside S"]
    if settings.mode != "monitor":
        wrong["no longer guaranteed though the contracts were kept"] = failed["lost"]
    if any(wrong.values()):
        say("ncs: of guaranteed states " + ", ".join(f"{count:,} were {what}" for what, count in wrong.items()))
        sys.exit(1)


def channels_of(own: Channel, contract: ChannelContract | None) -> dict[str, Channel]:
    """Returns a channel, and those that use its contract up by delays and by losses; without one a blackout."""
    if contract is None:
        return {"own": own, "blackout": Channel(loss=1.0)}
    age, step = contract.max_age, contract.quantization_step
    rare = Channel(loss=1.0, max_consecutive_losses=age, quantization_step=step)
    return {"own": own, "late": Channel(delay=age, quantization_step=step), "rare": rare}


def worst_case(certificate: Certificate, mode: str = "project") -> dict[str, Any]:
    """Returns settings of environments that push states out of the safe set, in mode "lookahead" out of the box."""
    S = certificate.safe_set
    push = {"rows": S.rows} if isinstance(S, Polytope) else {"M": np.linalg.inv(S.shape_matrix)}
    return {"noise": "extreme", "disturbance": AdversarialDisturbance(**({} if mode == "lookahead" else push))}


def starts(certificate: Certificate, rng: np.random.Generator, count: int, reach: float = _INWARD) -> np.ndarray:
    """Returns starts on the boundary of the safe set, shape (count, n), pulled in towards the state of rest."""
    center = certificate.resting_state
    return center + reach * (certificate.safe_set.sample_boundary(rng, count) - center)


def hostile_agents(
    certificate: Certificate, plant: LinearPlant, count: int, rng: np.random.Generator
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns what makes actions (N, m) of estimates (N, n): random, outwards, the gain turned round, bang-bang."""
    outwards = (plant.B.T @ plant.weight @ plant.A).T
    turned = -1e3 * (certificate.K / plant.input_half[:, None]).T
    signs, kinds = rng.choice([-1.0, 1.0], (count, plant.m)), 4 * np.arange(count)[:, None] // count

    def act(estimates: np.ndarray) -> np.ndarray:
        away = estimates - certificate.resting_state
        choices = rng.uniform(-1.0, 1.0, signs.shape), np.sign(away @ outwards), np.clip(away @ turned, -1.0, 1.0)
        return np.choose(kinds, [*choices, signs]).astype(np.float32)

    return act


def attacked(shield: VectorSafetyShield, rng: np.random.Generator) -> Iterator[Counter[str]]:
    """Plays an episode in each environment from the boundary of the safe set, and yields the counts of each step.

    "lost" is a guarantee that ended although the channels kept their contracts.
    """
    certificate, plant, count = shield.certificate, shield.filter.plant, shield.num_envs
    reach = _INWARD if shield.env.unwrapped.single.downlink is None else _BEHIND_DOWNLINK
    _, info = shield.reset(seed=int(rng.integers(2**31)), options={"state": starts(certificate, rng, count, reach)})
    act, kept = hostile_agents(certificate, plant, count, rng), info["shield_guaranteed"].copy()
    yield Counter(episodes=count)
    for _ in range(EPISODE_STEPS):
        *_, info = shield.step(act(info["estimate"]))
        guaranteed = info["shield_guaranteed"]
        kept &= ~(info["contract_broken"] | info.get("downlink_broken", False))
        where = {
            "steps": np.ones(count, np.bool_),
            "outside S": ~(certificate.safe_set.gauge(info["state"]) <= 1.0),
            "outside box": info["cost"] != 0.0,
            "no claim": ~guaranteed,
            "lost": kept & ~guaranteed,
            "overridden": info["shield_intervened"],
        }
        where |= {f"guaranteed {name}": guaranteed & where[name] for name in ("outside S", "outside box")}
        yield Counter({name: int(np.count_nonzero(found)) for name, found in where.items()})


def table_of(rows: dict[str, Counter[str]]) -> str:
    """Returns the counts of each case and their sum, with a legend."""
    total = sum(rows.values(), Counter[str]())
    columns = ("steps", "episodes", "outside S", "outside box", "no claim")
    table = [["", "", "", "outside", "outside", "no", ""]]
    table += [["case", "steps", "episodes", "S", "box", "claim", "overridden"]]
    env_id = ""
    for name, counts in [*rows.items(), ("all", total)]:
        before, (env_id, comma, kind) = env_id, name.rpartition(", ")
        table += [[env_id]] if comma and env_id != before else []
        numbers = [f"{counts[column]:,}" for column in columns]
        table.append([comma[1:] + kind, *numbers, f"{counts['overridden'] / counts['steps']:.1%}"])
    text = text_table(table, rules=(2, len(table) - 1))
    return "\n".join([f"{counted(EPISODE_STEPS, 'step')} in each episode\n", text, *map(wrapped, _LEGEND)])
