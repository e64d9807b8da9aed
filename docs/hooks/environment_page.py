"""The page of a registered environment, in the form of Gymnasium's: everything on it is asked of the environment.

`python docs/hooks/environment_page.py ncs_gym/CartPole-v0` prints one; `make docs` makes one of every id.
"""

import dataclasses
import inspect
import re
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

import docstring_parser
import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from ncs_gym import Channel, ChannelContract, Ellipsoid, LinearPlant, NCSEnv
from shields import Certificate, SafetyShield, verify

# Characters in a line of a block that fit the page.
WIDTH = 110
CAPTION = "*The last frame of a short episode behind the shield ([what is drawn](../ncs_gym.md#pictures)).*"


def environment_page(env_id: str, picture: str = "") -> str:
    """Returns the page of an environment as Markdown.

    Args:
        env_id: Id of a registered environment with a plant of its own.
        picture: Address of its picture; without one the page has none.
    """
    env, spec = gym.make(env_id).unwrapped, gym.spec(env_id)
    if not isinstance(env, NCSEnv):
        raise ValueError(f"{env_id} is not an environment of this package")
    docs = _sections(type(env))
    sections = {
        "Description": _description(env, spec),
        "Action space": docs["Action space"] + _actions(env.plant),
        "Observation space": _observations(env),
        "Rewards": _settings(env.task),
        "Starting state": docs["Starting state"] + _start(env),
        "Episode end": _end(env, spec),
        "Info": "All environments report [the same keys](../ncs_gym.md#every-key-of-info).",
        "Arguments": _arguments(env, spec),
        "Channel and contract": _channel(env),
        "Certificate": _certificate(env, SafetyShield(gym.make(env_id)).certificate),
        "Version history": _versions(spec),
    }
    head = [f"# {spec.name}", _summary(env, spec)]
    head += [f"![An episode of {env_id} behind a shield]({picture})", CAPTION] if picture else []
    body = [f"## {title}\n\n{text.strip()}" for title, text in sections.items()]
    return "\n\n".join(head + body) + "\n"


def _sections(kind: type) -> dict[str, str]:
    """Returns the parts of a class's docstring by their headings."""
    parts = re.split(r"^## (.+)$", inspect.getdoc(kind) or "", flags=re.MULTILINE)
    titles = [title.partition(" (")[0] for title in parts[1::2]]
    return {title: text.strip() + "\n\n" for title, text in zip(titles, parts[2::2], strict=True)}


def _summary(env: NCSEnv, spec: Any) -> str:
    rows = [
        ("Action space", f"`{_box(env.action_space)}`"),
        ("Observation space", f"`{_box(env.observation_space)}`"),
        ("Episode", f"{spec.max_episode_steps} steps of {env.plant.dt:g} s"),
        ("Make one", f'`gym.make("ncs_gym:{spec.id}")`'),
        ("Make many", f'`gym.make_vec("ncs_gym:{spec.id}", num_envs=64)`'),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {text} |" for name, text in rows)])


def _description(env: NCSEnv, spec: Any) -> str:
    """Returns what moves, in words: the docstring of the function that makes the plant, and the plant itself."""
    make = getattr(load_env_creator(spec.entry_point), "plant", None)
    texts = [f"`{make.__name__}()` {_prose(make, 'returns ')}"] if inspect.isfunction(make) else []
    process = getattr(env, "process", None)
    if dataclasses.is_dataclass(process):
        texts.append(f"What really moves is a `{type(process).__name__}`. {_prose(type(process))}")
    return "\n\n".join([*texts, f"```\n{_wrapped(str(env.plant), 16)}\n```"])


def _prose(documented: Any, verb: str = "") -> str:
    """Returns the description in a docstring, without its lists; `verb` stands for a leading "Returns "."""
    parsed = docstring_parser.parse(inspect.getdoc(documented) or "")
    text = "\n\n".join(filter(None, [parsed.short_description, parsed.long_description]))
    return verb + text.removeprefix("Returns ") if verb else text


def _wrapped(text: str, indent: int) -> str:
    """Returns lines that fit the width of a page."""
    spaces = " " * indent
    return "\n".join(textwrap.fill(line, WIDTH, subsequent_indent=spaces) for line in text.splitlines())


def _actions(plant: LinearPlant) -> str:
    rows = ["| entry | input | value at action 1 |", "|---|---|---|"]
    for index, name in enumerate(plant.input_names):
        rows.append(f"| {index} | {name} | {_with_unit(plant.input_ends[1, index], plant.input_units, index)} |")
    return "\n".join(rows)


def _observations(env: NCSEnv) -> str:
    rows = ["| entry | what | from | to |", "|---|---|---|---|"]
    space, plant = env.observation_space, env.plant
    extra = len(space.low) - plant.n
    names = [f"estimate of {name}" for name in plant.state_names] + [f"entry {i} of the task" for i in range(extra)]
    units = (*plant.state_units, *("" for _ in range(extra)))
    for index, name in enumerate(names):
        low, high = (_with_unit(bound[index], units, index) for bound in (space.low, space.high))
        rows.append(f"| {index} | {name} | {low} | {high} |")
    task = " [Rewards](#rewards) says what the task adds." if extra else ""
    cap = "" if plant.spectral_radius < 1.0 else " within a step of leaving the safe box; what is beyond is clipped"
    return "\n".join(rows) + f"\n\nThe limits are what can be reached within an episode{cap}.{task}"


def _settings(settings: Any) -> str:
    """Returns what a dataclass does, from its docstring, with the values of its fields."""
    parsed = docstring_parser.parse(inspect.getdoc(type(settings)) or "")
    meaning = {each.arg_name: " ".join((each.description or "").split()) for each in parsed.params}
    rows = [f"| `{name}` | {_value(value)} | {_cell(meaning.get(name, ''))} |" for name, value in _fields(settings)]
    head = ["| setting | value | meaning |", "|---|---|---|"]
    table = "\n\n" + "\n".join(head + rows) if rows else ""
    return f"`{type(settings).__name__}`: {_prose(type(settings))}{table}"


def _start(env: NCSEnv) -> str:
    return f"Here `initial_set` reaches {_reach(env.initial_set, env.plant)}."


def _end(env: NCSEnv, spec: Any) -> str:
    violation = "ends the episode" if env.terminate_on_violation else "does not end the episode"
    return (
        f"A violation of the safe box {violation} (`terminate_on_violation={env.terminate_on_violation}`). "
        f"An episode is truncated after {spec.max_episode_steps} steps."
    )


def _arguments(env: NCSEnv, spec: Any) -> str:
    """Returns the keywords of `gym.make` with the values they have here."""
    parsed = docstring_parser.parse(inspect.getdoc(type(env)) or "")
    rows = ["| argument | default here | meaning |", "|---|---|---|"]
    for each in parsed.params:
        if each.args[0] != "param":
            continue
        value = getattr(env, each.arg_name, None)
        value = getattr(value, "channel", value)  # an environment keeps a downlink's protocol, of which this was given
        rows.append(f"| `{each.arg_name}` | {_value(value)} | {_cell(each.description)} |")
    return "\n".join(rows) + f"\n\n`gym.make` takes `max_episode_steps` besides, {spec.max_episode_steps} by default."


def _channel(env: NCSEnv) -> str:
    texts = [env.channel.description, _contract(env.contract, env.channel)]
    downlink = env.downlink_protocol
    if downlink.channel is not None:
        texts.append(
            f"Between controller and actuator is a network as well: `{downlink.channel}`. "
            f"An action takes effect {_steps(downlink.input_delay)} later."
        )
        if env.contract is not None:
            texts[-1] += f" The certificate rests on both, {_steps(env.certificate_contract.max_age)} in all."
    return "\n\n".join(texts)


def _steps(number: int) -> str:
    return "1 step" if number == 1 else f"{number} steps"


def _contract(contract: ChannelContract | None, channel: Channel) -> str:
    if contract is None:
        return "No [contract](../contracts.md) is needed: the plant is stable, whatever the network does."
    rounding = f", and samples are quantized with step {contract.quantization_step:g} or finer"
    return (
        f"The [contract](../contracts.md) of the channel: no sample in use is older than {_steps(contract.max_age)}"
        f"{rounding if contract.quantization_step else ''}. The guarantee rests on it."
    )


def _certificate(env: NCSEnv, certificate: Certificate) -> str:
    report = verify(certificate, env.plant)
    count = len(report.conditions)
    verified = f"`verify` finds that all {count} conditions hold in exact arithmetic." if report.valid else str(report)
    unbroken = str(certificate).replace("\n" + 14 * " ", " ")
    text = (
        "The [shield](../shield.md) here rests on a certificate that comes with the package; for a changed plant or "
        "contract another one is synthesized:"
    )
    return f"{text}\n\n```\n{_wrapped(unbroken, 14)}\n```\n\n{verified}"


def _versions(spec: Any) -> str:
    """Returns the versions of an environment that are registered."""
    same = [each for each in gym.registry.values() if (each.namespace, each.name) == (spec.namespace, spec.name)]
    lines = [f"* `v{each.version}`{': first version' if each.version == 0 else ''}" for each in same]
    return "\n".join(lines) + "\n\nA change that alters results makes a new version."


def _reach(ellipsoid: Ellipsoid, plant: LinearPlant) -> str:
    """Returns how far an ellipsoid of states reaches, in the units of the states."""
    radii = np.sqrt(np.diag(ellipsoid.shape_matrix))
    reach = (_with_unit(radius, plant.state_units, index) for index, radius in enumerate(radii))
    return ", ".join(f"{name} {far}" for name, far in zip(plant.state_names, reach, strict=True))


def _with_unit(value: float, units: Sequence[str], index: int) -> str:
    return f"{value:.4g} {units[index]}".strip()


def _fields(settings: Any) -> list[tuple[str, Any]]:
    return [(each.name, getattr(settings, each.name)) for each in dataclasses.fields(settings)]


def _box(space: Any) -> str:
    low, high = space.low, space.high
    bounds = f"{low[0]:g}, {high[0]:g}" if np.ptp(low) == np.ptp(high) == 0.0 else "low, high"
    return f"Box({bounds}, {space.shape}, {space.dtype})"


def _value(value: Any) -> str:
    """Returns a value for a cell of a table: an object by its kind, whose settings other sections have."""
    if isinstance(value, np.ndarray):
        return f"`{value.tolist()}`"
    if value is None or isinstance(value, str | int | float | tuple):
        return f"`{value!r}`".replace("|", "\\|")
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIOU' else 'a'} `{name}`"


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


if __name__ == "__main__":
    print(environment_page(*sys.argv[1:2]), end="")
