"""Gains and error shapes by pattern of arrivals, each computed once for any number of environments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_gym.estimation.estimator import Belief, Estimator

# Entries a table begins with; arrays double when they are full.
FIRST_CAPACITY = 256
# Patterns beyond this are forgotten but for those in use.
MOST_NODES = 1 << 17
UNKNOWN = -1
# Columns of `GainTable.edges`.
TARGET, ACCEPTED, FRESH, HELD = range(4)
LAST_BIT = 30


class Spread(NamedTuple):
    """Covariance and shape, (n, n) each, of a belief whose newest sample has an age (capped where it no longer counts).

    What a belief is but for its mean: none of it depends on measurements or inputs, only on what arrived when.
    """

    covariance: np.ndarray
    shape: np.ndarray
    age: int


class Node(NamedTuple):
    """Everything but means that an estimator remembers: indices of spreads, and which samples it holds.

    Attributes:
        belief: Now.
        priors: Before the update at the step of each age 0..buffer; UNKNOWN before the first step.
        held: Whether the sample of each age has arrived.
    """

    belief: int
    priors: tuple[int, ...]
    held: tuple[bool, ...]


class GainTable:
    """A graph whose nodes are what arrived when, as far as it matters, and whose edges are predictions and packets.

    Spreads are rounded by the estimator, so that they recur; nodes with equal spreads are one. The arrays are read by
    compiled code; entries are UNKNOWN until `predict` or `receive` computes them, with the estimator's own methods.

    Args:
        estimator: Whose prediction, update and choice of history the table holds.

    Attributes:
        nodes: Node after a prediction, and edge of a packet of age delay + i, shape (nodes, 1 + jitter + 1).
        shapes: Sigma_k of each node, shape (n * n, nodes).
        edges: Node an edge leads to, whether the replayed history is kept, age of the newest sample used after it
            (UNKNOWN if as before), and the ages of samples used in the replay as bits (the last for all older ones);
            shape (edges, 4).
        weights: Its gain, zero where it is not used, n * p numbers, and (seen + N)^-1 of the monitor's quick test,
            p * p numbers; shape (buffer + 1, n * p + p * p, edges).
        turns: F of the axes common to H Sigma_k H' before each update and to N, shape (edges, buffer + 1, p, p).
        values: Squares of the former's half-axes there, shape (edges, buffer + 1, p); see `minkowski.common_axes`.
            NaN where N is flat in float64: such a residual always raises the alarm.
    """

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator
        channel, plant = estimator.channel, estimator.plant
        self.buffer, self._first_age = estimator.buffer, channel.delay
        n, p, ages = plant.n, plant.p, self.buffer + 1
        certified = estimator.error_set.ages
        self._oldest = max(self.buffer + 1, 0 if certified is None else len(certified.shapes))
        self._spreads: list[Spread] = []
        self._spread_index: dict[tuple[bytes, bytes, int], int] = {}
        self._predictions: dict[int, int] = {}
        self._updates: dict[int, tuple[int, np.ndarray]] = {}
        self._nodes: list[Node] = []
        self._node_index: dict[Node, int] = {}
        self._edges = 0
        self.nodes = np.full((FIRST_CAPACITY, 1 + channel.jitter + 1), UNKNOWN, np.int32)
        self.shapes = np.zeros((n * n, FIRST_CAPACITY))
        self.edges = np.zeros((FIRST_CAPACITY, 4), np.int32)
        self.weights = np.zeros((ages, n * p + p * p, FIRST_CAPACITY))
        self.turns = np.zeros((FIRST_CAPACITY, ages, p, p))
        self.values = np.zeros((FIRST_CAPACITY, ages, p))
        first = self._spread(plant.initial_cov, plant.initial_error.shape, 0)
        self.root = self._node(Node(first, (UNKNOWN,) * ages, (False,) * ages))

    def __len__(self) -> int:
        return len(self._nodes)

    def predict(self, node: int) -> int:
        """Returns the node one step later, without packets."""
        if self.nodes[node, 0] == UNKNOWN:
            belief, priors, held = self._nodes[node]
            moved = self._moved(belief)
            # The array may be another one once there is a new node.
            after = self._node(Node(moved, (moved, *priors[:-1]), (False, *held[:-1])))
            self.nodes[node, 0] = after
        return int(self.nodes[node, 0])

    def receive(self, node: int, age: int) -> int:
        """Returns the edge of a packet of some age that arrives."""
        column = 1 + age - self._first_age
        if self.nodes[node, column] == UNKNOWN:
            edge = self._replay(node, age)
            self.nodes[node, column] = edge
        return int(self.nodes[node, column])

    def keeping(self, live: np.ndarray) -> tuple[GainTable, np.ndarray]:
        """Returns a table with the nodes `live` (k,) only, and their numbers in it; this one if it is small enough."""
        if len(self) < MOST_NODES:
            return self, live
        table = GainTable(self.estimator)
        numbers = {node: table._adopted(self, self._nodes[node]) for node in np.unique(live).tolist()}
        return table, np.array([numbers[node] for node in live.tolist()], np.int32)

    def _adopted(self, other: GainTable, node: Node) -> int:
        """Returns the number of another table's node."""

        def same(spread: int) -> int:
            return spread if spread == UNKNOWN else self._spread(*other._spreads[spread])

        return self._node(Node(same(node.belief), tuple(map(same, node.priors)), node.held))

    def _spread(self, covariance: np.ndarray, shape: np.ndarray, age: int) -> int:
        """Returns the index of a spread, a new one if it has not occurred."""
        age = min(age, self._oldest)
        key = covariance.tobytes(), shape.tobytes(), age
        if key not in self._spread_index:
            self._spread_index[key] = len(self._spreads)
            self._spreads.append(Spread(covariance, shape, age))
        return self._spread_index[key]

    def _node(self, node: Node) -> int:
        """Returns the number of a node, a new one if it has not occurred."""
        if node not in self._node_index:
            number = self._node_index[node] = len(self._nodes)
            self._nodes.append(node)
            if number == len(self.nodes):
                self._double("nodes")
                self._double("shapes")
            self.shapes[:, number] = self._spreads[node.belief].shape.ravel()
        return self._node_index[node]

    def _double(self, name: str) -> None:
        array, axis = getattr(self, name), -1 if name in ("shapes", "weights") else 0
        more = np.full_like(array, UNKNOWN) if array.dtype == np.int32 else np.zeros_like(array)
        setattr(self, name, np.concatenate([array, more], axis))

    def _moved(self, spread: int) -> int:
        """Returns the spread one step later."""
        if spread not in self._predictions:
            covariance, shape, age = self._spreads[spread]
            estimator = self.estimator
            zero = np.zeros(estimator.plant.n)
            belief = estimator._predict(Belief(zero, covariance, shape, 0), np.zeros(estimator.plant.m), age)
            self._predictions[spread] = self._spread(belief.covariance, belief.shape, age + 1)
        return self._predictions[spread]

    def _updated(self, spread: int) -> tuple[int, np.ndarray]:
        """Returns the spread after an update, and the gain, (n, p): zero if the sample is not used."""
        if spread not in self._updates:
            covariance, shape, age = self._spreads[spread]
            update = self.estimator.update_of(covariance, shape, age)
            if update is None:
                plant = self.estimator.plant
                self._updates[spread] = spread, np.zeros((plant.n, plant.p))
            else:
                self._updates[spread] = self._spread(update.covariance, update.shape, 0), update.gain
        return self._updates[spread]

    def _replay(self, node: int, age: int) -> int:
        """Returns a new edge: the history from a packet's stamp on, and whether it is kept."""
        estimator, edge = self.estimator, self._new_edge()
        belief, priors, held = self._nodes[node]
        held = tuple(there or each == age for each, there in enumerate(held))
        replayed, spread = list(priors), priors[age]
        self.edges[edge, HELD] = 0
        for each in range(age, -1, -1):
            spread = replayed[each]
            if held[each]:
                seen = estimator.plant.H @ self._spreads[spread].shape @ estimator.plant.H.T
                spread, gain = self._updated(spread)
                self.turns[edge, each], self.values[edge, each] = estimator.residual_axes(seen)
                self.edges[edge, HELD] |= 1 << min(each, LAST_BIT)
                self.weights[each, :, edge] = np.append(gain, estimator.inverse_of_bound(seen))
            if each > 0:
                replayed[each - 1] = self._moved(spread)
        now, then = self._spreads[belief], self._spreads[spread]
        if estimator.prefers(then.shape, then.age, now.shape, now.age):
            fresh = then.age if then.age < self._oldest else UNKNOWN
            self.edges[edge, :HELD] = self._node(Node(spread, tuple(replayed), held)), True, fresh
        else:
            self.edges[edge, :HELD] = self._node(Node(belief, priors, held)), False, UNKNOWN
        return edge

    def _new_edge(self) -> int:
        edge = self._edges
        self._edges += 1
        if edge == len(self.edges):
            for name in ("edges", "weights", "turns", "values"):
                self._double(name)
        return edge
