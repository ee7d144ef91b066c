import subprocess
import sys
import textwrap

import numba
import numpy as np

from lab.base import compiled as module
from lab.base.compiled import compiled

MODULE = """
    from lab.base.compiled import compiled

    @compiled()
    def inner(a, b):
        return a + b

    @compiled()
    def outer(values):
        total = values[0] * 0
        for i in range(values.size):
            total = inner(total, values[i])
        return total
"""
CALLER = """
    import sys
    import numpy as np
    from summed import outer

    kinds = [np.float64, np.int64, np.float32, np.complex128]
    turn = int(sys.argv[1])
    for kind in kinds[turn:] + kinds[:turn]:
        assert outer(np.arange(5).astype(kind)) == 10, kind
    assert len(outer.signatures) == 4
"""


def _callers(folder, home):
    (folder / "summed.py").write_text(textwrap.dedent(MODULE))
    (folder / "call.py").write_text(textwrap.dedent(CALLER))
    environment = {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": f"{folder}:{home}", "PATH": ""}
    return [
        subprocess.Popen(
            [sys.executable, str(folder / "call.py"), str(turn)], env=environment, stderr=subprocess.PIPE, text=True
        )
        for turn in range(4)
    ]


def test_processes_that_fill_one_cache_at_once_all_find_their_own_signatures(tmp_path, pytestconfig):
    for _ in ("filled", "read"):
        for caller in _callers(tmp_path, pytestconfig.rootpath):
            _, said = caller.communicate(timeout=100)
            assert caller.returncode == 0, said
    # Four signatures of two functions: numba alone forgets or mixes some when it is raced.
    assert len(list((tmp_path / "cache").rglob("*.nbc"))) == 8


def test_one_process_at_a_time_compiles(monkeypatch):
    """A function is built while its folder's lock is held, once for itself and what it calls."""
    held = []
    real = module._locked

    def watched(path):
        held.append(path.name)
        return real(path)

    monkeypatch.setattr(module, "_locked", watched)

    @compiled()
    def half(x):
        return x / 2

    @compiled()
    def quarter(x):
        return half(half(x))

    assert quarter(8.0) == 2.0
    assert held == ["numba.lock"]


def test_functions_work_where_nothing_can_be_cached(monkeypatch):
    real = numba.njit

    def without_cache(**options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return real(**options)

    monkeypatch.setattr(numba, "njit", without_cache)
    assert compiled(nogil=True)(lambda x: x + 1)(np.float64(2.0)) == 3.0
