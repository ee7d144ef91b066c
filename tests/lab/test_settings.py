import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.base.errors import RequestError
from lab.settings.load import load_settings, parse_settings
from lab.settings.sections import BALL_RADIUS_CM
from lab.settings.settings import Settings


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
        ("robot = []", "list 1 to 8 robots"),
        ("robot = ['virtual', 'ble:SB-1234']", "make all virtual"),
        ("robot = ['virtual', 'virtual']\n[led]\ncolours = ['red']", "as many colours"),
        ("[led]\ncolours = ['mauve']", "no LED colour"),
        ("camera = 'none'\nrobot = ['virtual', 'virtual']\n[motion]\nturning = 'interior'", "need lambert"),
        ("[motion]\nturning = 'uniform'\nweighting = 'run_length'", "disc arena alone"),
        ("[motion]\nturning = 'spiral'", "motion.turning"),
        ("[motion]\nweighting = 'run_length'", "would bias"),
        ("[arena]\nring_cm = 0", "arena.ring_cm"),
        ("[link]\nreconnect_s = -1", "link.reconnect_s"),
        ("[[virtual.faults]]\nkind = 'flood'\nat_s = 3", "virtual.faults.0.kind"),
        ("[[virtual.faults]]\nkind = 'stall'", "virtual.faults.0.at_s"),
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


def test_the_lines_lie_a_balls_radius_inside_the_walls_or_within_the_ring():
    rectangle, disc = {"width_cm": 100.0, "height_cm": 80.0}, {"kind": "disc", "radius_cm": 50.0}
    for edge, off_cm in (("bump", BALL_RADIUS_CM), ("dark_ring", 6.0), ("bright_ring", 6.0)):
        found = parse_settings({"arena": {**rectangle, "edge": edge, "ring_cm": 6.0}}, origin="t").arena
        half_w, half_h = 50 - off_cm, 40 - off_cm
        assert found.lines_within.bounds == pytest.approx((-half_w, -half_h, half_w, half_h))
        assert found.longest_line_cm == pytest.approx(2 * math.hypot(half_w, half_h))
        round_one = parse_settings({"arena": {**disc, "edge": edge, "ring_cm": 6.0}}, origin="t").arena
        assert round_one.lines_within.area == pytest.approx(math.pi * (50 - off_cm) ** 2, rel=1e-3)
        assert round_one.longest_line_cm == pytest.approx(2 * (50 - off_cm), rel=1e-4)
        assert found.reachable.bounds[2] == pytest.approx(50 - BALL_RADIUS_CM)
        if edge == "bump":
            assert found.ring is None
        else:
            assert found.ring.area == pytest.approx(100 * 80 - 88 * 68)
            assert round_one.ring.area == pytest.approx(math.pi * (50**2 - 44**2), rel=1e-3)


def test_a_ring_wider_than_the_arena_is_refused():
    settings = parse_settings({"arena": {"edge": "dark_ring", "ring_cm": 46.0}}, origin="t")
    with pytest.raises(RequestError, match="ring of 46 cm"):
        _ = settings.arena.lines_within


def test_simulate_puts_a_virtual_robot_in_the_place_of_each_real_one():
    real = {"projector": "display:1", "camera": "none"}
    several = load_settings(None, {**real, "robot": ["ble:SB-0001", "ble:SB-0002"]}, simulate=True)
    assert several.robots == ("virtual", "virtual")
    assert several.is_virtual
    alone = load_settings(None, {**real, "robot": "onboard:CL-0001"}, simulate=True)
    assert alone.robots == ("onboard:virtual",)
    assert load_settings(None, {**real, "robot": "ble:SB-0001", "camera": "usb:0"}, simulate=True).camera == "virtual"


def test_the_profile_is_read_and_the_settings_speed_lies_over_it(tmp_path):
    assert load_settings(None).profile().cm_s_per_unit == 0.59
    file = tmp_path / "p.toml"
    file.write_text("cm_s_per_unit = 0.7\nleast_speed_units = 9\n")
    assert load_settings(None, {"robot_profile": str(file)}).profile().cm_s_per_unit == 0.7
    profile = load_settings(None, {"robot_profile": str(file), "motion.cm_s_per_unit": 0.8}).profile()
    assert (profile.cm_s_per_unit, profile.least_speed_units) == (0.8, 9)
    with pytest.raises(RequestError, match=r"none.toml"):
        load_settings(None, {"robot_profile": str(tmp_path / "none.toml")}).profile()


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
    faults = [{"kind": "stall", "at_s": 3.0}]
    for keys in (
        {"arena.kind": "disc", "stop.until": 0.95},
        {"robot": ["virtual", "virtual"], "camera": "none", "virtual.faults": faults},
        {"robot": "onboard:virtual"},
    ):
        settings = load_settings(None, keys)
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
