"""Pickles as data: what they hold is told, and nothing in them is imported, called or made.

A pickle is a program for a machine with a stack. This machine has no dangerous half: where a pickle names a class or a
function, it keeps the name; where it calls one, it keeps what it would have been called with.
"""

from __future__ import annotations

import pickletools
from collections.abc import Iterable
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from ncs_gym.reading import require_moderate
from ncs_gym.validation import reason_of

# How numpy's arrays and numbers are pickled, by numpy 1 and 2, and the types of those that are read.
_ARRAYS = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_BUFFERS = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
_NUMBERS = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
_DTYPES = ("f8", "f4")
# Operations that put their argument, nothing, or an empty collection on the stack, or take so many entries for a tuple.
_VALUES = {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT"}
_VALUES |= {"SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_SET": set}
# Most values in a key of a dictionary, shared ones counted wherever they stand: hashes take as long.
_MOST_IN_KEYS = 20
# A dictionary that is called for instead.
_ORDERED = "collections.OrderedDict"
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
# Longest name of a class with its module [letters], and largest number [bits].
_LONGEST_NAME, _LARGEST_NUMBER = 200, 4096
# Most dimensions of an array, and most entries along each.
_MOST_DIMENSIONS, _LONGEST_AXIS = 32, 1 << 32
# Most operations of a pickle, each of which may make an object from one byte: statistics and spaces take hundreds.
_MOST_OPERATIONS = 100_000


# Name of what is kept outside of a pickle, as torch keeps numbers.
STORED = "stored elsewhere"


@dataclass(frozen=True)
class Named:
    """A class or function that a pickle names.

    Attributes:
        name: Its module and its own name, with a dot between them.
    """

    name: str


@dataclass(eq=False)
class Made:
    """What a pickle would make.

    Attributes:
        name: Module and name of what it would call for that; empty for what has no name.
        arguments: With what.
        state: What it would set then; None for nothing.
    """

    name: str
    arguments: tuple[Any, ...]
    state: Any = None

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes that the state would set."""
        return self.state if isinstance(self.state, dict) else {}


def pickled_data(data: bytes) -> Any:
    """Returns what a pickle holds, of protocol 2 or later, as Python 3 and torch write them.

    Returns:
        Numbers, texts, bytes, lists, tuples, dictionaries and sets; `Named` and `Made` for everything else; what is
        kept outside of the pickle is `Made` with the name `STORED`, and what says where.

    Raises:
        ValueError: If it is no such pickle, has more than 100,000 operations, or a name or number of it is too long.
    """
    try:
        machine = _Machine()
        for number, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if number >= _MOST_OPERATIONS:
                raise ValueError(f"it has more than {_MOST_OPERATIONS:,} operations")
            if opcode.name == "STOP":
                return machine.pop()
            machine.do(opcode.name, argument)
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"it is no pickle that is read here: {reason_of(error)}") from error
    raise ValueError("it is no pickle: it does not end")


def array_of(value: Any) -> np.ndarray:
    """Returns the array of floats that a part of what `pickled_data` returns stands for.

    Raises:
        ValueError: If it stands for none.
    """
    try:
        return _array_of(value)
    except (ArithmeticError, LookupError) as error:  # a number that is too large, an entry that is missing
        raise ValueError(f"it has no array that is read here: {reason_of(error)}") from error


def _array_of(value: Any) -> np.ndarray:
    if type(value) in (int, float):
        return np.array(value, dtype=np.float64)
    if isinstance(value, Made):
        if value.name in _ARRAYS and isinstance(value.state, tuple) and len(value.state) == 5:
            _, shape, dtype, is_fortran, raw = value.state
            return _array(raw, dtype, shape, "F" if is_fortran is True else "C")
        if value.name in _BUFFERS and len(value.arguments) == 4:
            raw, dtype, shape, order = value.arguments
            return _array(raw, dtype, shape, order)
        if value.name in _NUMBERS and len(value.arguments) == 2:
            return _array(value.arguments[1], value.arguments[0], (), "C")
    raise ValueError("it has something else in the place of an array")


def _array(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    """Returns an array of bytes whose number is right; raises ValueError for anything else."""
    code = dtype.arguments[0] if isinstance(dtype, Made) and dtype.name == "numpy.dtype" and dtype.arguments else None
    byte_order = dtype.state[1] if isinstance(dtype, Made) and isinstance(dtype.state, tuple) else "<"
    if code not in _DTYPES or byte_order not in ("<", ">", "=", "|") or not is_shape(shape) or order not in ("C", "F"):
        raise ValueError("it has an array of another kind")
    if not isinstance(raw, bytes | bytearray) or len(raw) != prod(shape) * int(code[1:]):
        raise ValueError("it has an array of another size than it says")
    return np.frombuffer(raw, dtype=byte_order.replace("|", "=") + code).reshape(shape, order=order).astype(np.float64)


def is_shape(shape: Any) -> bool:
    """Returns whether these are the sizes of an array, of which the product can be taken."""
    fits = isinstance(shape, tuple) and len(shape) <= _MOST_DIMENSIONS
    return fits and all(type(size) is int and 0 <= size <= _LONGEST_AXIS for size in shape)


class _Machine:
    """The stack, the marks on it, and what is remembered by number."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def pop(self) -> Any:
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise ValueError("its stack is empty")
        return self.stack.pop()

    def since_mark(self) -> list[Any]:
        start = self.marks.pop()
        taken = self.stack[start:]
        del self.stack[start:]
        return taken

    def do(self, name: str, argument: Any) -> None:
        """Executes one operation; any that is not listed is refused."""
        push = self.stack.append
        if name in _VALUES:
            if isinstance(argument, int) and argument.bit_length() > _LARGEST_NUMBER:
                raise ValueError(f"it has a number of more than {_LARGEST_NUMBER:,} bits")
            push(argument)
        elif name in _CONSTANTS:
            push(_CONSTANTS[name])
        elif name in _EMPTY:
            push(_EMPTY[name]())
        elif name in _TUPLES:
            push(tuple(reversed([self.pop() for _ in range(_TUPLES[name])])))
        elif name in ("PROTO", "FRAME"):
            pass
        elif name == "MARK":
            self.marks.append(len(self.stack))
        elif name == "TUPLE":
            push(tuple(self.since_mark()))
        elif name == "FROZENSET":
            push(frozenset(_hashable(self.since_mark())))
        elif name == "POP":
            self.pop()
        elif name == "POP_MARK":
            self.since_mark()
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = self.stack[-1]
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[argument] = self.stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            push(self.memo[argument])
        elif name == "GLOBAL":
            push(_named(*argument.split(" ", 1)))
        elif name == "STACK_GLOBAL":
            own, module = self.pop(), self.pop()
            push(_named(module, own))
        elif name == "BINPERSID":
            push(Made(STORED, (self.pop(),)))
        elif name in ("REDUCE", "NEWOBJ", "NEWOBJ_EX"):
            named = self.pop() if name == "NEWOBJ_EX" else None
            arguments, by = self.pop(), self.pop()
            if not isinstance(arguments, tuple):
                raise ValueError("it calls something with what are no arguments")
            made = Made(by.name if isinstance(by, Named) else "", (arguments, named) if named else arguments)
            push({} if made.name == _ORDERED and not arguments else made)
        else:
            self.fill(name)

    def fill(self, name: str) -> None:
        """Executes an operation that puts something into what is on the stack; what only a call would take is lost."""
        if name in ("APPENDS", "ADDITEMS", "SETITEMS"):
            entries = self.since_mark()
        elif name == "SETITEM":
            entries = list(reversed([self.pop(), self.pop()]))
        elif name in ("APPEND", "BUILD"):
            entries = [self.pop()]
        else:
            raise ValueError(f"it has the operation {name}")
        target = self.stack[-1]
        if name == "BUILD":
            if isinstance(target, Made):
                target.state = entries[0]
        elif isinstance(target, dict):
            target.update(zip(_hashable(entries[::2]), entries[1::2], strict=True))
        elif isinstance(target, list):
            target.extend(entries)
        elif isinstance(target, set):
            target.update(_hashable(entries))


def _named(module: Any, own: Any) -> Named:
    """Returns a name; raises ValueError for one that no class has, before two long ones are put together."""
    if not all(isinstance(each, str) and len(each) <= _LONGEST_NAME and each.isprintable() for each in (module, own)):
        raise ValueError("it names a class by what is no name")
    return Named(f"{module}.{own}")


def parts_of(value: Any) -> Iterable[Any]:
    """Returns the values in a part of what `pickled_data` returns."""
    if isinstance(value, dict):
        return [*value, *value.values()]
    if isinstance(value, Made):
        return (*value.arguments, value.state)
    return value if isinstance(value, list | tuple | set | frozenset) else ()


def _hashable(keys: list[Any]) -> list[Any]:
    """Returns keys whose hashes are found soon, although tuples may share entries; raises ValueError for others."""
    for key in keys:
        require_moderate(key, parts_of, _MOST_IN_KEYS)
    return keys
