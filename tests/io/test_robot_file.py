import json
import math
import tomllib

import numpy as np
import pytest

from jaxslam.io import quantities, robot_file
from jaxslam.io.errors import InputError
from jaxslam.io.robot_file import EXAMPLE, SECTIONS
from jaxslam.simulation import kinematics, scanner_presets
from jaxslam.simulation.arguments import as_robot, check_lidar_of
from jaxslam.simulation.robot import Robot
from jaxslam.simulation.scanners import Scanner, pieces

PLAIN = """
[scanner]
preset = "LDS-01"
[kinematics]
type = "differential"
wheel_base = "160 mm"
[odometry]
encoder_noise = "5 mm"
[limits]
max_speed = "0.22 m/s"
max_turn_rate = "1 rad/s"
"""
CAR = (
    PLAIN.replace("differential", "ackermann")
    .replace('max_turn_rate = "1 rad/s"', "")
    .replace('type = "ack', 'max_steering = "30 deg"\ntype = "ack')
    .replace('encoder_noise = "5 mm"', 'encoder_noise = "5 mm"\nsteering_noise = "0.3 deg"')
)
OMNI = PLAIN.replace("differential", "holonomic").replace(
    'encoder_noise = "5 mm"', 'slip_noise = ["5 mm", "8 mm/sqrt(m)", "1 deg"]'
)
OWN = """
beams = 270
field_of_view = "270 deg"
scan_rate = "10 Hz"
range_min = "10 cm"
range_max = "12 m"
range_noise = "8 mm + 0.5 %"
"""


@pytest.fixture
def read(tmp_path):
    """Read a text as a file."""

    def of(text, name="robot.toml"):
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
        return robot_file.read(tmp_path / name)

    return of


@pytest.fixture
def refused(read, tmp_path):
    """Message of a text that is refused, without the path, which it must name."""

    def of(text, name="robot.toml"):
        with pytest.raises(InputError) as error:
            read(text, name)
        message = str(error.value)
        assert message.startswith(str(tmp_path / name)) and "\n" not in message
        return message.removeprefix(str(tmp_path / name))

    return of


def with_scanner(lines):
    return PLAIN.replace('preset = "LDS-01"', lines)


def test_the_documented_example_is_read(read):
    found = read(EXAMPLE)
    robot, scanner = found.robot, found.robot.scanner
    base = scanner_presets.preset("RPLidar A2")
    assert (found.name, robot.kinematics, robot.wheel_base) == (
        "delivery robot",
        "differential",
        0.32,
    )
    assert (robot.encoder_noise, robot.wheel_scales) == (0.004, (1.004, 0.998))
    assert robot.wheel_base_scale == pytest.approx(1.01)
    assert (robot.max_speed, robot.odometry_rate, robot.scan_period) == (0.8, 50.0, 0.2)
    assert robot.max_turn_rate == pytest.approx(np.deg2rad(60))
    assert robot.nominal_mount == pytest.approx((0.12, 0.0, 0.0)) and robot.mount == (0, 0, 0)
    assert robot.time_offset == -0.02 and robot.radius == pytest.approx(np.hypot(0.5, 0.4) / 2)
    assert scanner.lidar()[:4] == base.lidar()[:4] and scanner.scan_rate == 5.0
    assert scanner.range_noise == pieces((0.0, 0.008, 0.0), (1.0, 0.0, 0.01))
    assert as_robot(robot) == robot and hash(robot) == hash(as_robot(robot))
    check_lidar_of(robot, scanner.lidar())
    assert found.notes == ()  # the errors of the preset are not used
    line = found.describe()
    assert "\n" not in line and "delivery robot: differential, wheel base 0.32 m" in line
    assert (
        "RPLidar A2: 800 beams over 360 degrees, 5 Hz, 0.15 to 12 m, noise 30.0 mm at 3 m" in line
    )


def test_every_documented_key_is_known_and_the_other_way_round():
    text = robot_file.__doc__
    for name, keys in SECTIONS.items():
        assert f"[{name}]" in text
        for key in keys:
            assert key in text, key


def test_json_of_the_same_tree_is_the_same_robot(read):
    text = json.dumps(tomllib.loads(EXAMPLE))
    assert read(text, "robot.json") == read(EXAMPLE) == read(text, "robot.conf")


def test_numbers_alone_have_si_units(read):
    texts = {'"160 mm"': "0.16", '"5 mm"': "0.005", '"0.22 m/s"': "0.22", '"1 rad/s"': "1"}
    plain = PLAIN
    for text, number in texts.items():
        plain = plain.replace(text, number)
    assert plain != PLAIN and read(plain) == read(PLAIN)


def test_a_plain_robot_has_only_what_is_given(read):
    found = read(PLAIN)
    expected = Robot(
        wheel_base=0.16,
        encoder_noise=0.005,
        scan_period=0.2,
        max_speed=0.22,
        max_turn_rate=1.0,
        scanner=scanner_presets.preset("LDS-01"),
    )
    assert found.robot == expected and found.name == "without a name"
    assert "a third of its precision is assumed" in found.notes[0]


def test_a_car_and_a_robot_that_slides(read):
    car, omni = read(CAR).robot, read(OMNI).robot
    assert car.kinematics == "ackermann" and car.max_steering == pytest.approx(np.pi / 6)
    assert car.steering_noise == pytest.approx(np.deg2rad(0.3))
    radius = 0.16 / np.tan(np.pi / 6)
    assert kinematics.turning_radius(car) == pytest.approx(radius)
    assert car.max_turn_rate == pytest.approx(0.22 / radius)
    assert "turning radius 0.28 m" in read(CAR).describe()
    wide = read(CAR.replace('type = "ack', 'min_turning_radius = "1 m"\ntype = "ack')).robot
    assert kinematics.turning_radius(wide) == 1.0 and wide.max_turn_rate == 0.22
    assert omni.kinematics == "holonomic"
    assert omni.slip_noise == pytest.approx((0.005, 0.008, np.deg2rad(1)))
    for robot in (car, omni):
        kinematics.noise_params(robot)


def test_delays_are_clock_offsets_with_their_signs(read):
    """A scan that is stamped late was taken earlier; odometry that is, has its clock ahead."""
    timing = '[timing]\ntime_offset = "10 ms"\nodometry_latency = "0.05 s"\nscan_latency = "20 ms"'
    assert read(PLAIN + timing).robot.time_offset == pytest.approx(0.01 + 0.05 - 0.02)


def test_mounts_known_and_unknown(read):
    text = '[mount]\nx = "25 cm"\nyaw = "90 deg"\n[mount_error]\ny = "-5 mm"\nyaw = "1 deg"'
    robot = read(PLAIN + text).robot
    assert robot.nominal_mount == pytest.approx((0.25, 0.0, np.pi / 2))
    assert robot.mount == pytest.approx((0.0, -0.005, np.pi / 180))
    assert read(PLAIN + '[body]\nradius = "20 cm"').robot.radius == 0.2


def test_a_scanner_of_ones_own(read):
    scanner = read(with_scanner(OWN + 'name = "mine"\nbeam_divergence = "3 mrad"')).robot.scanner
    step = np.deg2rad(270 / 269)
    assert scanner == Scanner(
        "mine",
        270,
        pytest.approx(-np.deg2rad(135)),
        pytest.approx(step),
        10.0,
        0.1,
        12.0,
        range_noise=pieces((0.0, 0.008, 0.005)),
        beam_divergence=0.003,
    )
    assert scanner.assumptions() == ()


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ('beams = 720\nfield_of_view = "360 deg"', (720, -np.pi, np.pi / 360)),
        ('beams = 720\nangle_increment = "0.5 deg"', (720, -np.pi, np.pi / 360)),
        ('field_of_view = "360 deg"\nangle_increment = "0.33 deg"', (1091, -np.pi, None)),
        ('field_of_view = "180 deg"\nangle_increment = "1 deg"', (181, -np.pi / 2, np.pi / 180)),
        ('beams = 541\nangle_increment = "0.5 deg"', (541, -0.75 * np.pi, np.pi / 360)),
        ('beams = 541\nfield_of_view = "270 deg"', (541, -0.75 * np.pi, np.pi / 360)),
        (  # as makers count: beams x increment
            'beams = 1080\nfield_of_view = "270 deg"\nangle_increment = "0.25 deg"',
            (1080, -1079 / 1440 * np.pi, np.pi / 720),
        ),
        (
            'beams = 181\nangle_increment = "1 deg"\nangle_min = "-80 deg"',
            (181, -4 / 9 * np.pi, np.pi / 180),
        ),
    ],
)
def test_two_numbers_of_three_give_the_beams(read, lines, expected):
    own = OWN.replace('beams = 270\nfield_of_view = "270 deg"', lines)
    scanner = read(with_scanner(own)).robot.scanner
    beams, first, step = expected
    assert scanner.num_beams == beams and scanner.angle_min == pytest.approx(first)
    assert scanner.angle_increment == pytest.approx(2 * np.pi / beams if step is None else step)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("beams = 180", (180, -np.pi, np.pi / 90)),
        ('angle_increment = "2 deg"', (180, -np.pi, np.pi / 90)),
        ('field_of_view = "180 deg"', (181, -np.pi / 2, np.pi / 180)),
        ('angle_min = "0 deg"', (360, 0.0, np.pi / 180)),
    ],
)
def test_one_number_changes_the_beams_of_a_preset(read, lines, expected):
    scanner = read(with_scanner(f'preset = "LDS-01"\n{lines}')).robot.scanner
    found = scanner.num_beams, scanner.angle_min, scanner.angle_increment
    assert found == pytest.approx(expected)
    assert scanner.precision == scanner_presets.preset("LDS-01").precision


def test_what_is_better_than_the_source_of_a_preset_is_noted(read):
    text = 'preset = "LDS-01"\nscan_rate = "50 Hz"\nrange_max = "3 m"\nrange_min = "1 cm"'
    notes = [x for x in read(with_scanner(text)).notes if "by its source" in x]
    assert notes == [
        "preset LDS-01: scan_rate is 50 Hz, and 5 Hz by its source",
        "preset LDS-01: range_min is 0.01 m, and 0.12 m by its source",
    ]
    assert not any("source" in x for x in read(with_scanner('preset = "LDS-01"')).notes)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            'range_noise = "5 mm"\nprecision = "9 mm"',
            "scanner.precision: says nothing beside range",
        ),
        (
            'range_noise = ["5 mm", "9 mm from 20 m"]',
            "range_noise: a piece from 20 m says nothing: ",
        ),
    ],
)
def test_errors_that_say_nothing_are_refused(read, lines, message):
    with pytest.raises(InputError, match=message):
        read(with_scanner(f'preset = "LDS-01"\n{lines}'))


def test_errors_of_a_preset_give_place_to_those_of_the_file(read):
    text = 'preset = "TiM571"\naccuracy = ["20 mm", "2 % from 2 m"]'
    scanner = read(with_scanner(text)).robot.scanner
    np.testing.assert_allclose(scanner.range_std(np.array([1.0, 3.0])), [0.02 / 3, 0.02])
    assert (scanner.range_noise, scanner.precision) == (None, None)
    assert not any("TiM55x" in note for note in scanner.assumptions())
    kept = read(with_scanner('preset = "LDS-02"\nrange_max = "6 m"')).robot.scanner
    assert any(note.startswith("preset LDS-02: its manual") for note in kept.assumptions())


@pytest.mark.parametrize("kind", quantities.UNITS)
def test_each_unit_is_read_and_a_unit_of_another_kind_is_not(kind):
    for unit, size in quantities.UNITS[kind].items():
        assert quantities.parse(f" -2.5e1 {unit}", kind) == pytest.approx(-25 * size)
    assert quantities.parse(3, kind) == 3.0
    with pytest.raises(InputError, match="has the unit 'lbs'; units are"):
        quantities.parse("3 lbs", kind)
    for value in ("", "m", "1,5 m", "nan m", "0x10 m", True, None, [1], {}, 10**400, math.inf):
        with pytest.raises(InputError):
            quantities.parse(value, kind)


def test_units_are_those_of_the_world():
    same = [
        ("180 deg", "angle", math.pi),
        ("36 km/h", "speed", 10.0),
        ("60 rpm", "turn rate", 2 * math.pi),
        ("300 rpm", "rate", 5.0),
        ("1 ft", "length", 0.3048),
        ("5 %", "ratio", 0.05),
        ("1.02", "ratio", 1.02),
    ]
    for text, kind, number in same:
        assert quantities.parse(text, kind) == pytest.approx(number)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("160 mm", "160 kg", ": kinematics.wheel_base: '160 kg' has the unit 'kg'; units are m,"),
        (
            '"160 mm"',
            '"160"',
            ": kinematics.wheel_base: '160' has no unit; units are m, cm",
        ),
        ('"160 mm"', "160", ": kinematics.wheel_base: 160 is not between 0.01 and 20 m; check its"),
        ('"160 mm"', "nan", ": kinematics.wheel_base: nan is not finite; write "),
        (
            '"160 mm"',
            "1979-05-27",
            ": kinematics.wheel_base: datetime.date(1979, 5, 27) is no leng",
        ),
        (
            "wheel_base",
            "wheelbase",
            ": kinematics.wheelbase: is an unknown key; did you mean wheel",
        ),
        (
            "wheel_base",
            "colour",
            ": kinematics.colour: is an unknown key; keys are type, wheel_base",
        ),
        (
            'wheel_base = "160 mm"',
            "",
            ": kinematics.wheel_base: is missing; add wheel_base, length",
        ),
        (
            "[odometry]",
            "[odometer]",
            ": odometer: is unknown; there are name, scanner, kinematics, ",
        ),
        ("[odometry]\nencoder_noise", "enc", ": kinematics.enc: is an unknown key; keys are"),
        ("[limits]", "[odometry.limits]", ": odometry.limits: is an unknown key"),
        ("[scanner]", "scanner = 3\n[mount]", ": scanner: is no section; write [scanner]"),
        (
            "differential",
            "tank",
            ": kinematics.type: 'tank' is unknown; types are differential, ac",
        ),
        ("LDS-01", "LDS-09", ": scanner.preset: no scanner named 'LDS-09'; presets are LDS-01, "),
        (
            '"5 mm"',
            '"5 mm"\nslip_noise = 3',
            ": odometry.slip_noise: is not of a drive that is diff",
        ),
        ('"5 mm"', '"5 mm"\nwheel_scales = [1]', ": odometry.wheel_scales: [1] is not two numbers"),
        ('"5 mm"', '"5 mm"\nwheel_scales = 9', ": odometry.wheel_scales: 9 is not between 0.2 and"),
        (
            '"5 mm"',
            '"5 mm"\nrate = "0 Hz"',
            ": odometry.rate: '0 Hz' is not between 0.1 and 100000",
        ),
        (
            "0.22 m/s",
            "9 m/s",
            ": robot moves 1.80 m and turns 0.20 rad from scan to scan, by max_s",
        ),
        ("\n[scanner]", 'name = ""\n[scanner]', ": name: '' is no text of one line; write it"),
        ("\n[scanner]", "[body]\nlength = 1\n[scanner]", ": body.width: is missing; give length"),
        (
            "\n[scanner]",
            "[body]\nlength = 1\nradius = 1\n[scanner]",
            ": body.radius: is given beside length or width; leave",
        ),
        ("[limits]", "[limits", ":9: is not TOML (Expected ']'"),
        ("[limits]", "[kinematics]", ":9: is not TOML (Cannot declare ('kinematics',) twice"),
    ],
)
def test_a_robot_that_is_not_possible_is_refused_in_a_line(refused, old, new, message):
    assert old in PLAIN
    assert refused(PLAIN.replace(old, new, 1)).startswith(message)


@pytest.mark.parametrize(
    ("text", "old", "new", "message"),
    [
        (
            CAR,
            'max_steering = "30 deg"',
            "",
            ": kinematics.max_steering: is missing; give it, or m",
        ),
        (CAR, '"30 deg"', '"30"', ": kinematics.max_steering: '30' has no unit; units are rad"),
        (CAR, '"30 deg"', "30", ": kinematics.max_steering: 30 is not between 0.01 and 1.5 rad"),
        (
            CAR,
            '"30 deg"',
            '"30 deg"\nmin_turning_radius = "0.2 m"',
            ": kinematics.min_turning_radius: 0.2 m contradicts max_steering and wheel_base; the",
        ),
        (CAR, 'steering_noise = "0.3 deg"', "", ": odometry.steering_noise: is missing"),
        (
            CAR,
            "[limits]",
            "wheel_scales = [1, 1]\n[limits]",
            ": odometry.wheel_scales: [1, 1] is not o",
        ),
        (
            OMNI,
            '"8 mm/sqrt(m)", ',
            "",
            ": odometry.slip_noise: ['5 mm', '1 deg'] is no list of three",
        ),
        (
            OMNI,
            '"1 deg"',
            '"1 mm"',
            ": odometry.slip_noise: '1 mm' has the unit 'mm'; units are rad",
        ),
        (
            OMNI,
            "slip_noise",
            "encoder_noise",
            ": odometry.encoder_noise: is not of a drive that is h",
        ),
    ],
)
def test_drives_are_refused_by_what_they_lack(refused, text, old, new, message):
    assert old in text
    assert refused(text.replace(old, new, 1)).startswith(message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "beams = 270",
            "",
            ": scanner.beams: is missing; give two of beams, field_of_view, angle_i",
        ),
        ("beams = 270", "beams = 270.5", ": scanner.beams: 270.5 is no whole number from 2 to"),
        (
            "beams = 270",
            'beams = 270\nangle_increment = "0.5 deg"',
            ": scanner.angle_increment: 0.5 degrees contradict beams and field_of_view; 270 bea",
        ),
        (
            "beams = 270",
            'angle_increment = "50 deg"',
            ": scanner.angle_increment: 50 degrees do not divide 270 degrees; give beams",
        ),
        (
            'field_of_view = "270 deg"',
            'angle_increment = "2 deg"',
            ": scanner.beams: 270 beams at 2 degrees are more than a circle; check angle_increment",
        ),
        ("270 deg", "400 deg", ": scanner.field_of_view: '400 deg' is not between 1e-05 and 6.28"),
        ("10 Hz", "0 Hz", ": scanner.scan_rate: '0 Hz' is not between 0.05 and 1000 Hz; check its"),
        ("10 Hz", "-3 Hz", ": scanner.scan_rate: '-3 Hz' is not between"),
        ("10 cm", "12 m", ": scanner.range_min: 12 m is not below range_max, 12 m; give both"),
        ('range_max = "12 m"', "", ": scanner.range_max: is missing; add range_max, length [m]"),
        ('range_noise = "8 mm + 0.5 %"', "", ': scanner.range_noise: is missing; write "10 mm"'),
        (
            "8 mm + 0.5 %",
            "8",
            ": scanner.range_noise: '8' has no unit; units are m, cm",
        ),
        (
            "8 mm + 0.5 %",
            "8 mm + 2 mm",
            ": scanner.range_noise: '8 mm + 2 mm' is no error of a rang",
        ),
        ("8 mm + 0.5 %", "80 %", ": scanner.range_noise: '80 %' is not between 0 and 0.5"),
        ('"8 mm + 0.5 %"', "0.01", ": scanner.range_noise: 0.01 is no error of a range; write"),
        ('"8 mm + 0.5 %"', "[]", ": scanner.range_noise: [] is no error of a range; write"),
        (
            '"8 mm + 0.5 %"',
            '["1 mm from 2 m", "2 mm from 1 m"]',
            ": scanner.range_noise: pieces are not in the order of their ranges; write",
        ),
    ],
)
def test_a_scanner_that_contradicts_itself_is_refused(refused, old, new, message):
    assert old in OWN
    assert refused(with_scanner(OWN.replace(old, new, 1))).startswith(message)


def test_files_that_are_none_are_refused(refused, tmp_path):
    assert refused(PLAIN.replace("[limits]", "").replace("max", "#")) == (
        ": has no section [limits]; " + robot_file.ADVICE
    )
    assert refused("", "robot.json").startswith(": is empty")
    assert refused(b"\xff\xfe name").startswith(": is not UTF-8; save it")
    assert refused('{"name": "a",\n"scanner" 3}', "robot.json").startswith(":2: is not JSON (Expe")
    assert refused('{"a": 1, "a": 2}', "robot.txt").startswith(": is not JSON (an object has the k")
    assert refused("[1]", "robot.json").startswith(": is no JSON object")
    assert refused('{"name": ' + "[" * 200 + "]" * 200 + "}", "robot.json").startswith(
        ": is nested"
    )
    with pytest.raises(InputError, match="does not exist; check the name"):
        robot_file.read(tmp_path / "none.toml")


def test_no_change_of_the_example_ends_otherwise_than_in_a_line(read):
    """Every line left out, and every value replaced by one of another kind."""
    lines, ends = EXAMPLE.splitlines(), 0
    for number in range(len(lines)):
        for value in (None, '""', '"x"', "-1", "true", "[]", "{}", '"1e400 m"', '["1 m"]', "inf"):
            changed = list(lines)
            if value is None:
                del changed[number]
            elif "=" in changed[number]:
                changed[number] = changed[number].partition("=")[0] + f"= {value}"
            try:
                read("\n".join(changed))
            except InputError:
                ends += 1
    assert ends > 100
