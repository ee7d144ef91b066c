"""The notebooks, run in a fresh kernel as a reader would; what they find against truths worked out here."""

import importlib.util
import json
import math
import re

import nbformat
import pytest

from tests.docs.shown import HOME

NOTEBOOKS = sorted((HOME / "docs/notebooks").glob("*.ipynb"))
SESSION, PLAN = "from-a-session-to-the-figures", "plan-an-experiment"
NUMBER = r"[+\-−]?\d+(?:\.\d+)?(?:e-\d+)?"


@pytest.fixture(scope="module", autouse=True)
def _a_kernel_of_another_python(tmp_path_factory):
    """What a user may have installed under the same name; it must not be started."""
    folder = tmp_path_factory.mktemp("jupyter")
    spec = folder / "kernels/python3/kernel.json"
    spec.parent.mkdir(parents=True)
    spec.write_text(json.dumps({"argv": ["no-such-python"], "display_name": "Python 3", "language": "python"}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JUPYTER_PATH", str(folder))
        patch.setenv("JUPYTER_PREFER_ENV_PATH", "0")
        yield


@pytest.fixture(scope="module")
def run():
    """The notebooks as they come out when they are run now; each once."""
    found = importlib.util.spec_from_file_location("make_notebooks", HOME / "docs/notebooks/make.py")
    make = importlib.util.module_from_spec(found)
    found.loader.exec_module(make)
    return {path.stem: make.executed(path) for path in NOTEBOOKS}


def printed(notebook) -> str:
    """All text that the cells give, tables as plain text."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "\n".join(output.get("text") or output["data"].get("text/plain", "") for output in outputs)


def figures_after(text: str, start: str) -> list[list[float]]:
    """The numbers of every line that begins with ``start``."""
    rows = [line[len(start) :] for line in text.splitlines() if line.startswith(start)]
    return [[float(number) for number in re.findall(NUMBER, row)] for row in rows]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_is_stored_is_small_and_whole(path):
    assert path.stat().st_size < 300_000
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert set(notebook.metadata) == {"kernelspec"}
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert not [output for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    for cell in cells:
        pictures = [output for output in cell.outputs if "image/png" in output.get("data", {})]
        assert bool(pictures) == bool(cell.metadata.get("mystnb", {}).get("image", {}).get("alt")), cell.source


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_is_stored_is_what_comes_out(path, run):
    """But for the digits, which may differ from one processor to another."""
    stored, now = (
        re.sub(r"\s+", " ", re.sub(NUMBER, "#", printed(notebook)))
        for notebook in (nbformat.read(path, as_version=4), run[path.stem])
    )
    assert stored == now


def test_the_session_is_read_as_it_was(run):
    text = printed(run[SESSION])
    log = (HOME / "data/sessions/eiffel/events.jsonl").read_text(encoding="utf-8")
    runs = log.count('"event": "line"')
    assert f"{runs} runs, 150 of them crossed the shape" in text
    (tower, square), (tower_p, square_p) = figures_after(text, "A (cm²)"), figures_after(text, "P (cm)")
    by_hand, estimated, sigma, truth = tower
    assert by_hand == estimated
    assert abs(estimated - truth) < 3 * sigma
    assert truth == pytest.approx(1478.5, abs=0.1)  # the paper's tower, at its 71 cm
    assert tower_p[3] == pytest.approx(403.8, abs=0.1)
    # a square of 44 cm, whatever the library says
    assert (square[3], square_p[3]) == (44**2, 4 * 44)
    for robot, camera, error, true in (square, square_p):
        assert abs(robot - true) < 3 * error
        assert abs(camera - true) < 3 * error
        assert abs(robot - camera) < error
    assert "chords: 16 matched, 0 missed, 0 made up" in text


def test_the_wrong_turning_is_found_and_the_right_one_is_not(run):
    text = printed(run[SESSION])
    p_values = {found[0]: float(found[1]) for found in re.findall(rf"turning (\w+): .*p = ({NUMBER})", text)}
    assert p_values["uniform"] < 0.01 < p_values["lambert"]
    assert "Eiffel Tower: posterior 1.0000" in text


def test_the_plan_obeys_cauchy_and_crofton_and_was_kept_by_the_session(run):
    text = printed(run[PLAN])
    width, height = 120 - 7.3, 90 - 7.3  # a ball's diameter less than between the walls
    mean_run = math.pi * width * height / (2 * (width + height))
    assert figures_after(text, "mean run ")[0][0] == pytest.approx(mean_run, abs=0.05)
    share = 226.785 / (2 * (width + height))  # the tower's hull
    assert figures_after(text, "share of the runs that cross the tower: ")[0][0] == pytest.approx(100 * share, abs=0.5)
    for row in ("runs for 150 crossing lines", "minutes "):
        planned, rolled = figures_after(text, row)[0][:2]
        assert planned == pytest.approx(rolled, rel=0.1), row
    assert figures_after(text, "runs for 150 crossing lines")[0][0] == pytest.approx(150 / share, rel=0.02)


def test_the_scatter_of_a_circle_is_that_of_its_chords(run):
    """Its chords are 2√(R² − p²) with p uniform, so that ⟨ℓⁿ⟩ has a closed form; the rest is the delta method."""
    row, radius = figures_after(printed(run[PLAN]), "Circle")[0], 32.0
    mean = {
        n: (2 * radius) ** n * math.sqrt(math.pi) / 2 * math.gamma(n / 2 + 1) / math.gamma(n / 2 + 1.5)
        for n in range(7)
    }
    c11, c13, c33 = (mean[a + b] / (mean[a] * mean[b]) - 1 for a, b in ((1, 1), (1, 3), (3, 3)))
    sigma_area = math.sqrt(c33 - 2 * c13 + c11)  # A ~ ⟨ℓ³⟩/⟨ℓ⟩
    sigma_perimeter = math.sqrt(c33 - 4 * c13 + 4 * c11)  # P ~ ⟨ℓ³⟩/⟨ℓ⟩², k being 1
    assert row[0] == pytest.approx(math.pi * radius**2, rel=1e-3)
    assert row[2:4] == [pytest.approx(sigma_area, abs=0.006), pytest.approx(sigma_perimeter, abs=0.006)]
    assert row[4:] == [math.ceil((sigma / 0.05) ** 2) for sigma in (sigma_area, sigma_perimeter)][: len(row) - 4]
