"""What really moves: the plant's own equations, a function, or (`gym_process`) another environment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ncs_gym.plants.linear_plant import LinearPlant
from ncs_gym.validation import ReadOnlyArrays, as_flag, as_setting, shown


class Process:
    """What really moves; the plant is the certified model of it (docs/beyond_linear.md).

    Past inputs that are states of the plant are kept by the environment: a process moves the others, with the input
    that acts, and gets a plant of them alone. One object may serve any number of environments; what keeps something at
    run time returns another process from `opened`.

    Attributes:
        vectorized: Whether `step` takes any number of states and inputs at once; a subclass does not inherit it.
        is_written: Whether it can be put into a state, to start episodes there and to let disturbances act.
        terminated, truncated: Whether it ended the episode by itself; arrays (N,) for many environments.
    """

    vectorized: bool = False
    is_written: bool = True
    terminated: Any = False
    truncated: Any = False

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Takes a promise about a method from a subclass, which may override it."""
        super().__init_subclass__(**keywords)
        cls.vectorized = vars(cls).get("vectorized", False)

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns what moves in one environment (None) or in `size` of them.

        Raises:
            ValueError: If the process does not fit the plant.
        """
        return self

    # Those of the present episode, shape (k,), or of N, (N, k); None if episodes do not differ.
    parameters: Any = None

    def read_parameters(self, given: Any, *, anywhere: bool = False) -> np.ndarray | None:
        """Returns what an option of `reset` fixes of the parameters of episodes (`Family.read`)."""
        if given is not None:
            raise ValueError("options['parameters'] is for the plant of a family (ncs_gym.family)")
        return None

    def choose(self, rng: np.random.Generator, chosen: np.ndarray | None, fixed: np.ndarray | None) -> None:
        """Draws the parameters of episodes that begin in the chosen environments, but for fixed ones."""

    def start(self, rng: np.random.Generator, state: np.ndarray, chosen: np.ndarray | None) -> np.ndarray:
        """Starts episodes, and returns the states that they start in.

        Args:
            rng: Source of randomness.
            state: Where to start, shape (n,), or (n, k) for k chosen environments.
            chosen: Numbers of these, shape (k,); None without that axis.
        """
        return state

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns the next state without disturbance, shape (n,) or (n, N), for inputs (m,) or (m, N)."""
        raise ValueError(f"a {type(self).__name__} moves only once it is opened")

    def step_many(self, plant: LinearPlant, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Returns what `step` does for states (n, N) and inputs (m, N), at once or one by one."""
        if self.vectorized:
            return self.step(plant, states, inputs)
        each = [self.step(plant, x, u) for x, u in zip(states.T, inputs.T, strict=True)]
        return np.array(each, dtype=np.float64).T

    def write(self, state: np.ndarray) -> np.ndarray:
        """Puts everything that has not ended into a state, shape (n,) or (n, N), and returns what is read back."""
        return state

    def close(self) -> None:
        """Closes what was opened."""


@dataclass(frozen=True)
class LinearProcess(Process):
    """The plant's own equations and disturbances: the certified model is the truth."""

    vectorized: ClassVar[bool] = True

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns A x + B u."""
        return plant.A.dot(state) + plant.B.dot(u)


@dataclass(frozen=True)
class FamilyProcess(Process):
    """The equations of another member of the plant's family in every episode (`ncs_gym.family`)."""

    vectorized: ClassVar[bool] = True

    def opened(self, plant: LinearPlant, size: int | None) -> Process:
        """Returns what moves the members of the present episodes."""
        if plant.members is None:
            raise ValueError("FamilyProcess is for the plant of a family: make it by ncs_gym.family")
        return _Members(plant, plant.members, size)


class _Members(Process):
    """One member of a family, or one for each of `size` environments; the middle until they are chosen."""

    vectorized = True

    def __init__(self, plant: LinearPlant, family: Any, size: int | None) -> None:
        self._family, self._size = family, size
        count = 1 if size is None else size
        self._matrices = np.tile(np.column_stack([plant.A, plant.B, np.zeros(plant.n)]), (count, 1, 1))
        self._parameters = np.full((count, len(family.names)), np.nan)

    @property
    def parameters(self) -> np.ndarray:
        """Those of the present episodes, in the order of the family's names."""
        return self._parameters.copy() if self._size is not None else self._parameters[0].copy()

    def read_parameters(self, given: Any, *, anywhere: bool = False) -> np.ndarray:
        """Returns the parameters that an option fixes, shape (k,) or (N, k)."""
        return self._family.read(given, self._size, anywhere=anywhere)

    def choose(self, rng: np.random.Generator, chosen: np.ndarray | None, fixed: np.ndarray | None) -> None:
        """Draws members."""
        values = np.full_like(self._parameters, np.nan) if fixed is None else fixed.reshape(self._parameters.shape)
        for e in range(len(values)) if chosen is None else chosen.tolist():
            drawn = self._family.drawn(rng, values[e])
            self._matrices[e] = self._family.member(drawn)
            self._parameters[e] = drawn

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns A_i x + B_i u + s_i."""
        joint = np.concatenate([state, u, np.ones((1, *state.shape[1:]))])
        if self._size is None:
            return self._matrices[0].dot(joint)
        return np.einsum("eij,je->ie", self._matrices, joint)


def own_process(plant: LinearPlant) -> Process:
    """Returns what moves by default: the plant's own equations, or those of its family's members."""
    return LinearProcess() if plant.members is None else FamilyProcess()


def as_process(value: Any) -> Process:
    """Returns a process; raises ValueError if it is none."""
    if isinstance(value, Process):
        return value
    raise ValueError(f"process must be of type Process, such as FunctionProcess(f), got {type(value).__name__}")


@dataclass(frozen=True)
class FunctionProcess(ReadOnlyArrays, Process):
    """x+ = f(x, u) + d for a function f; d is what the plant declares beside its remainder.

    Attributes:
        function: Returns x+, shape (n,), given x, (n,), and u, (m,) [physical units].
        vectorized: Whether it also takes arrays (n, N) and (m, N) of many environments, and returns (n, N).

    Raises:
        ValueError: If the function is none, or `vectorized` no truth value.
    """

    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    vectorized: bool = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise ValueError(f"the process must be a function (x, u) -> x+, got {shown(self.function)}")
        self._check(as_flag, "vectorized")

    def step(self, plant: LinearPlant, state: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Returns what the function returns; raises ValueError if that is no finite state."""
        value = self.function(state.copy(), u.copy())
        x_next = as_setting(value)
        if x_next is None or x_next.shape != state.shape or not np.isfinite(x_next).all():
            raise ValueError(f"the process must return a finite next state of shape {state.shape}, got {shown(value)}")
        return x_next
