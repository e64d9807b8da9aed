"""`make address` writes the project's address into every file that names it, and takes it out again."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = runpy.run_path(str(ROOT / ".ci" / "address.py"))
PLACES, ADDRESS = SCRIPT["PLACES"], "https://example.org/own/ncs-gym"


@pytest.mark.parametrize("name", PLACES)
def test_address_is_written_into_every_place_of_a_file_and_taken_out_again(name):
    write, own = SCRIPT["with_address"], (ROOT / name).read_text()
    without, given = write(name, own, ""), write(name, own, ADDRESS)
    assert given.count(ADDRESS) >= sum("{}" in line for _, line, _ in PLACES[name])
    assert "example.org" not in without
    assert write(name, given, "") == without
    assert write(name, without, ADDRESS) == write(name, given, ADDRESS) == given
    with pytest.raises(ValueError, match="has no place for the address"):
        write(name, "", ADDRESS)


@pytest.mark.parametrize("address", ["http://example.org", "example.org", "https://a b", "https://"])
def test_what_is_no_address_is_refused_before_anything_is_written(address):
    with pytest.raises(ValueError, match=r"the address has to be https://\.\.\."):
        SCRIPT["main"](address)
