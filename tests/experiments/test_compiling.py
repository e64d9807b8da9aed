import pytest
from numba import njit

from experiments import certify, pool
from experiments.compiling import ANNOUNCEMENT, announced, compile_first


def test_compiling_is_announced_once_with_its_duration_and_nothing_is_said_without(capsys):
    @njit
    def doubled(x):
        return 2 * x

    with announced():
        assert doubled(2) == 4
        assert doubled(2.5) == 5.0
    said = capsys.readouterr()
    assert said.err.splitlines()[0] == ANNOUNCEMENT
    assert said.err.splitlines()[1].startswith("compiled in ")
    assert (len(said.err.splitlines()), said.out) == (2, "")
    with announced():
        assert doubled(3) == 6
    assert capsys.readouterr().err == ""


def test_loops_are_compiled_before_there_are_workers(monkeypatch):
    class Compiled(Exception):
        """Stands for the first call."""

    def compile_now():
        raise Compiled

    for module in (pool, certify):
        monkeypatch.setattr(module, "compile_first", compile_now)
    with pytest.raises(Compiled):
        pool.run_all([], 1, 0, lambda unit, result: None)
    with pytest.raises(Compiled):
        certify._run(None, {"case": [None]}, {}, None, 1)


def test_nothing_is_left_to_compile_after_it(capsys):
    compile_first()
    capsys.readouterr()
    compile_first()
    assert capsys.readouterr().err == ""
