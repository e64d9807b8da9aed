"""Prints what certificates keep of the published plants: `python -m experiments.published [--attack STEPS] [names]`."""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from typing import Any

import numpy as np

from experiments.published.attack import attack
from experiments.published.largest_share import largest_share
from experiments.published.plants import contract_of_plant, plant_of, published
from experiments.terminal import wrapped
from ncs_gym import LinearPlant
from shields import Certificate, Infeasible, synthesize, verify

_COLUMNS = ("plant", "n, m", "age", "limits", "share", "at most", "rows", "time [s]")
_WIDTHS = (18, 6, 4, 10, 9, 8, 5, 8)


def main(arguments: list[str]) -> None:
    """Prints a row for every plant, and in the end how many have a certificate.

    With `--attack` each certificate is attacked for so many steps, too.

    Raises:
        SystemExit: If a name is none of theirs.
    """
    parser = argparse.ArgumentParser(prog="python -m experiments.published", description=__doc__)
    parser.add_argument("names", nargs="*", help="plants; all by default")
    parser.add_argument("--attack", type=int, default=0, metavar="STEPS", help="attacked steps of each certificate")
    options = parser.parse_args(arguments)
    names, total, outside = options.names, 0, 0
    if options.attack < 0:
        parser.error(f"--attack must be a number of steps, got {options.attack}")
    if unknown := [name for name in names if name not in published()]:
        raise SystemExit(f"no published plant is called {unknown[0]}; there are {', '.join(published())}")
    print(_row(*_COLUMNS))
    found = 0
    for name in names or published():
        with warnings.catch_warnings():  # the page says where operating points move
            warnings.simplefilter("ignore")
            began, plant = time.perf_counter(), plant_of(name)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                certificate = synthesize(plant, contract=contract_of_plant(name))
        except Infeasible as infeasible:
            kept = f"none ({infeasible.binding})"
            print(_row(name, *_sizes(name, plant), kept, "", "", f"{time.perf_counter() - began:.1f}"), flush=True)
            continue
        assert verify(certificate, plant).valid
        took = time.perf_counter() - began
        found += 1
        print(_row(name, *_sizes(name, plant), *_kept(plant, certificate), f"{took:.1f}"), flush=True)
        if options.attack:
            counts = attack(plant, certificate, options.attack)
            total, outside = total + counts.steps, outside + counts.exits + counts.violations
            outcome = f"{counts.exits} outside the set, {counts.violations} outside the limits"
            text = f"attacked for {counts.steps:,} steps: {outcome}, {counts.unproved} unproved"
            print(wrapped(text, label="  "), flush=True)
    if options.attack:
        print(f"{outside} of {total:,} attacked steps left a set or broke a limit")
    print(f"{found} of {len(names or published())} have a certificate")


def _sizes(name: str, plant: LinearPlant) -> tuple[str, str, str]:
    free = plant.n - int(np.linalg.matrix_rank(plant.box))
    kind = "symmetric" if plant.is_symmetric else "two ends"
    return f"{plant.n}, {plant.m}", str(published()[name]["max_age"]), kind if not free else f"{free} free"


def _kept(plant: LinearPlant, certificate: Certificate) -> tuple[str, str, str]:
    share = certificate.provenance.get("polytope_share_of_box")
    rows = "" if certificate.polytope is None else str(len(certificate.polytope.rows))
    if share is None or (at_most := largest_share(plant)) is None:
        return "no box", "", rows
    return f"{share:.3f}", f"{at_most:.2f}", rows


def _row(*texts: Any) -> str:
    return " ".join(f"{text:<{width}}" for text, width in zip(texts, _WIDTHS, strict=True)).rstrip()


if __name__ == "__main__":
    main(sys.argv[1:])
