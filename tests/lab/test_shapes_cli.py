"""`chordlab shapes` as a user meets it."""

import json

import pytest
from PIL import Image, ImageDraw

from lab.cli.main import main
from projector.dictionary import shape_from

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="200mm" height="200mm" viewBox="0 0 20 20">{}</svg>'


@pytest.fixture
def say(capsys, tmp_path, monkeypatch):
    """Run a command in an empty folder; give its exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*argv):
        code = main([str(word) for word in argv])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def as_json(out: str):
    (line,) = out.splitlines()
    return json.loads(line)


def test_list_by_collection(say):
    names = {}
    for collection in ("paper", "monuments", "letters"):
        code, out, _ = say("shapes", "list", "--collection", collection, "--json")
        assert code == 0
        found = as_json(out)
        names[collection] = [entry["name"] for entry in found["shapes"]]
        assert all(entry["area_cm2"] > 0 and entry["pieces"] >= 1 for entry in found["shapes"])
    assert names["paper"] == [entry["name"] for entry in as_json(say("shapes", "list", "--json")[1])["shapes"]]
    assert len(names["monuments"]) >= 32
    assert "text:A" in names["letters"]
    assert "monuments, " in say("shapes", "list", "--collection", "monuments")[1]


def test_show_one_several_and_a_collection(say, tmp_path):
    code, out, _ = say("shapes", "show", "eiffel", "--json")
    assert (code, as_json(out)["name"]) == (0, "eiffel")
    assert (tmp_path / "eiffel.png").read_bytes().startswith(b"\x89PNG")
    code, out, _ = say("shapes", "show", "circle", "square", "--out", "sub/two.svg")
    assert code == 0
    assert out.splitlines()[-1] == "sub/two.svg"
    assert "<svg" in (tmp_path / "sub/two.svg").read_text()
    code, out, _ = say("shapes", "show", "--collection", "paper", "text:Q", "--json")
    found = as_json(out)
    assert [shape["name"] for shape in found["shapes"]][-1] == "text:Q"
    assert (tmp_path / found["picture"]).stat().st_size > 1000


def test_import_a_drawing_and_use_it(say, tmp_path):
    (tmp_path / "tower.svg").write_text(SVG.format('<path d="M0 20 L10 0 L20 20 Z M8 18 h4 v-6 h-4 z"/>'))
    code, out, err = say("shapes", "import", "tower.svg", "--name", "my_tower", "--height", "50", "--json")
    assert (code, err) == (0, "")
    found = as_json(out)
    assert found["height_cm"] == pytest.approx(50)
    assert (found["name"], found["holes"], found["file"]) == ("my_tower", 1, "my_tower.geojson")
    # the paper's wedge of 20 x 20 less a door of 4 x 6, at 2.5 cm a unit
    assert found["area_cm2"] == pytest.approx((200 - 24) * 2.5**2, rel=1e-5)
    again = shape_from(str(tmp_path / "my_tower.geojson"))
    assert (again.digest, again.name) == (found["digest"], "my_tower")
    assert as_json(say("moments", "my_tower.geojson", "--json")[1])["area_cm2"] == pytest.approx(found["area_cm2"])


def test_import_says_what_it_did(say, tmp_path):
    image = Image.new("L", (300, 200), 255)
    ImageDraw.Draw(image).rectangle((100, 80, 199, 129), fill=0)
    image.save(tmp_path / "block.png", dpi=(10, 10))
    code, out, _ = say("shapes", "import", "block.png")
    assert code == 0
    assert "block: 25.4 x 12.7 cm" in out
    assert "size from the picture's 10 dpi" in out
    tie = {"type": "Polygon", "coordinates": [[[0, 0], [40, 30], [40, 0], [0, 30], [0, 0]]]}
    (tmp_path / "tie.geojson").write_text(json.dumps(tie))
    code, out, _ = say("shapes", "import", "tie.geojson", "--mend", "--out", "mended.geojson")
    assert code == 0
    assert "mended: Self-intersection" in out
    assert shape_from(str(tmp_path / "mended.geojson")).area_cm2 == pytest.approx(600)


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["list", "--collection", "animals"], "no collection of shapes"),
        (["show"], "nothing to show"),
        (["show", "eiffel", "--out", "eiffel.doc"], "a picture ends in"),
        (["show", "eiffel", "--out", "file/eiffel.png"], "cannot be written"),
        (["show", "square.geojson", "circle", "--collection", "paper"], "two different shapes are called square"),
        (["import", "nothing.svg"], "is not a file"),
        (["import", "square.geojson"], "called square already"),
        (["import", "square.geojson", "--name", "a/b"], "--name"),
        (["import", "square.geojson", "--name", "big", "--width", "300"], "does not fit"),
        (["import", "square.geojson", "--name", "big", "--width", "30", "--scale", "2"], "contradict"),
        (["import", "square.geojson", "--name", "x", "--out", "x.svg"], "GeoJSON"),
        (["import", "square.geojson", "--name", "x", "--out", "file/x.geojson"], "cannot be written"),
        (["import", "text:"], "text is empty"),
        (["import", "text:AB"], "--name"),
        (["separability", "eiffel"], "at least two"),
        (["separability", "eiffel", "square", "--confidence", "2"], "--confidence"),
        (["separability", "--lines", "0"], "--lines"),
        (["separability", "--out", "plot.txt"], "a picture ends in"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_request_is_one_line_and_exit_2(say, tmp_path, argv, says):
    ring = [[0, 0], [20, 0], [20, 20], [0, 20], [0, 0]]
    (tmp_path / "square.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    (tmp_path / "file").write_text("")
    code, out, err = say("shapes", *argv)
    assert (code, out) == (2, "")
    # which font stands in is told on a line of its own
    lines = [line for line in err.splitlines() if "stands in" not in line]
    assert len(lines) == 1
    assert says in lines[0]
    assert "Traceback" not in err


def test_separability_by_json_and_as_a_picture(say, tmp_path):
    code, out, err = say("shapes", "separability", "--lines", "40", "--out", "plane.svg", "--json")
    assert (code, err) == (0, "")
    found = as_json(out)
    assert (found["lines"], found["confidence"], found["picture"]) == (40, 0.95, "plane.svg")
    assert len(found["entries"]) == 6
    liberty = next(entry for entry in found["entries"] if entry["name"] == "liberty")
    assert liberty["plane"]["rival"] == "eiffel"
    assert liberty["plane"]["confusable"] == ["eiffel"]
    assert liberty["line"]["right"] > 0.99
    assert 40 < liberty["plane"]["lines"] < 80
    assert found["worst_pairs_by_plane"][0]["names"] == ["eiffel", "liberty"]
    assert (tmp_path / "plane.svg").read_text().count("<path") > 20


def test_separability_for_people(say, tmp_path):
    twin = shape_from("liberty").geometry
    mirrored = [[[-x, y] for x, y in ring.coords] for ring in (twin.exterior, *twin.interiors)]
    (tmp_path / "ytrebil.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": mirrored}))
    code, out, _ = say("shapes", "separability", "--collection", "paper", "ytrebil.geojson", "--lines", "30")
    assert code == 0
    assert "one class, as mirror or turned twins: liberty, ytrebil" in out
    assert "Worst pairs by (P, A)" in out
    assert "3 of 7 entries are confusable after 30 lines by (P, A)" in out
    assert "0 of 7 entries are confusable after 30 lines line by line" in out


def test_separability_through_the_sensor(say):
    code, out, _ = say("shapes", "separability", "square", "circle", "--sensor", "--json")
    assert code == 0
    assert [entry["line"]["lines"] for entry in as_json(out)["entries"]] == [10, 10]
