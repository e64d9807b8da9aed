"""Writes the project's public address into every file that names it, or takes it out: `make address ADDRESS=https://...`.

python .ci/address.py ADDRESS
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Where lines with the address stand in a file, how they read, and what stands there without one.
PLACES = {
    "pyproject.toml": [(r'^(?:Source = ".*"\n)?(?=Paper = )', 'Source = "{}"\n', "")],
    "CITATION.cff": [(r"^(?:repository-code: .*\n)?(?=authors:)", 'repository-code: "{}"\n', "")],
    "README.md": [
        (r"(?:\nThe project is at <.*>\.\n)?\Z", "\nThe project is at <{}>.\n", ""),
        (r"(?<=or later, )(?:in a clone.*|from its address):$", "from its address:", "in a clone of this repository:"),
        (r"(?<=^pip install )\".*\[train\].*\"$", '"ncs-gym[train] @ git+{}"', '".[train]"'),
    ],
    "mkdocs.yml": [(r"^(?:repo_url: .*\n)?(?=docs_dir: )", "repo_url: {}\n", "")],
    "examples/tour.ipynb": [
        (r"(?<=%pip install -q ).*\[train\].*(?=\"$)", r"\"ncs-gym[train] @ git+{}\"", r"\"..[train]\""),
    ],
}


def with_address(name: str, text: str, address: str) -> str:
    """Returns the text of a file with the address; without one if it is empty."""
    for pattern, line, without in PLACES[name]:
        made = line.format(address) if address else without
        text, count = re.subn(pattern, lambda _, made=made: made, text, count=1, flags=re.MULTILINE)
        if not count:
            raise ValueError(f"{name} has no place for the address: {pattern}")
    return text


def main(address: str) -> None:
    """Writes the address, or takes it out if it is empty."""
    if address and not re.fullmatch(r"https://[\w.-]+(/[\w.~-]+)*", address):
        raise ValueError(f"the address has to be https://..., got {address!r}")
    for name in PLACES:
        path = ROOT / name
        path.write_text(with_address(name, path.read_text(), address))
    print(f"{', '.join(PLACES)}: {address or 'no address'}")


if __name__ == "__main__":
    main(*sys.argv[1:])
