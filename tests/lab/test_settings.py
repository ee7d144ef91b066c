import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.settings import BALL_RADIUS_CM, Settings, load_settings, parse_settings


def test_defaults_are_a_virtual_session():
    settings = load_settings(None)
    assert settings.is_virtual
    assert settings.arena.reachable.bounds == pytest.approx((-56.35, -41.35, 56.35, 41.35))
    assert settings.camera_calibration().led_height_cm == 7.3


def test_a_file_is_read_and_flags_lie_over_it(tmp_path):
    file = tmp_path / "s.toml"
    file.write_text('shape = "circle"\n[stop]\nlines = 12\n[arena]\nkind = "disc"\nradius_cm = 50\n')
    settings = load_settings(file, {"stop.lines": 20, "seed": 7})
    assert (settings.shape, settings.stop.lines, settings.seed) == ("circle", 20, 7)
    assert settings.arena.polygon.area == pytest.approx(math.pi * 50**2, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("shap = 'x'", "shap is not a setting"),
        ("[motion]\nspeed = 3", "motion.speed is not a setting"),
        ("[motion]\nspeed_cm_s = -3", "motion.speed_cm_s"),
        ("[motion]\nspeed_cm_s = nan", "motion.speed_cm_s"),
        ("robot = 'carpet'", "ble:…"),
        ("robot = 'ble:'", "ble:…"),
        ("camera = 'none:1'", "camera"),
        ("robot = 'ble:SB-1234'", "virtual projector"),
        ("robot = 'ble:SB-1234'\nprojector = 'display:1'", "virtual camera"),
        ("lines = [", "is not TOML"),
        ("seed = -1", "seed"),
    ],
)
def test_a_fault_is_one_line_that_names_it(tmp_path, text, says):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(RequestError) as caught:
        load_settings(file)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "bad.toml" in str(caught.value)


def test_a_missing_file_and_one_that_is_no_text(tmp_path):
    with pytest.raises(RequestError, match="No such file"):
        load_settings(tmp_path / "none.toml")
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RequestError, match="not TOML"):
        load_settings(tmp_path / "x.toml")


def test_an_arena_too_small_for_the_ball_is_refused():
    settings = parse_settings({"arena": {"width_cm": 7.0, "height_cm": 7.0}}, origin="t")
    with pytest.raises(RequestError, match="too small"):
        _ = settings.arena.reachable


def test_every_setting_is_documented():
    def walk(model):
        for name, field in model.model_fields.items():
            kind = field.annotation
            nested = hasattr(kind, "model_fields")
            assert field.description or nested, f"{model.__name__}.{name}"
            if nested:
                assert kind.__doc__
                walk(kind)

    walk(Settings)


def test_what_the_manifest_holds_reads_back_to_the_same_settings():
    settings = load_settings(None, {"arena.kind": "disc", "stop.until": 0.95})
    assert parse_settings(settings.model_dump(mode="json"), origin="manifest") == settings


@given(
    st.recursive(st.none() | st.booleans() | st.floats() | st.text(), lambda inner: st.dictionaries(st.text(), inner))
)
def test_any_data_is_read_or_refused_in_one_line(data):
    if not isinstance(data, dict):
        data = {"motion": data}
    try:
        parse_settings(data, origin="t")
    except RequestError as error:
        assert "\n" not in str(error)


def test_the_ball_is_a_bolt():
    assert pytest.approx(7.3) == BALL_RADIUS_CM * 2
