"""Common scanners, each number from a document or a driver that is named beside it.

Documents, by the letters used below:

    [E1], [E2]  ROBOTIS e-Manual, TurtleBot3, appendices LDS-01 and LDS-02: tables "General
                Specifications" and "Measurement Performance Specifications"
    [H]         driver ROBOTIS-GIT/hls_lfcd_lds_driver, src/hlds_laser_publisher.cpp
    [D]         driver ROBOTIS-GIT/ld08_driver, src/lipkg.cpp
    [A1]        SLAMTEC, RPLIDAR A1 data sheet (A1M8), figure 2-1, "Performance"
    [A2]        SLAMTEC, RPLIDAR A2 data sheet (A2M8), rev. 2.5, 2019-10-25, "Introduction"
    [R]         driver Slamtec/rplidar_ros, src/node.cpp
    [C]         tables of scanners by users, not by the maker: comments of a Cartographer
                configuration for the S2, and a comparison in the report of a robot contest
    [L]         LDROBOT LD19 performance parameters, as in the user guide of Autolabor (ld19/intro)
    [S]         Hokuyo, Communication protocol specification for SCIP 2.0, C-42-03320B: table 2, and
                the example of the PP command
    [P4], [P30] Hokuyo's product specifications of URG-04LX ("Accuracy") and UTM-30LX ("Measurement
                resolution"), as users quote them
    [PL]        driver sicklms200 of Player, its documentation
    [ST]        driver ros-drivers/sicktoolbox_wrapper, ros/sicklms/sicklms.cpp
    [T1]        SICK, technical information TiM55x/56x/57x, 8015883/YZK8/2016-07-07, chapter 5
    [T2]        SICK, data of TiM55x and TiM56x, 8015886/YDR0/2014-08-27, "Measurement error"
    [UT]        driver uos/sick_tim, launch/sick_tim571_2050101.launch and the parser it uses
    [CS]        driver ipa320/cob_driver, cob_sick_s300
    [BS]        driver bohlender/sicks300, src/sicks300.cpp and src/serialcomm_s300.cpp
"""

import math
import re

from jaxslam.simulation.scanners import FULL_CIRCLE, Scanner, pieces

DEGREE = math.pi / 180
HOKUYO_STEP = FULL_CIRCLE / 1024  # [rad] of the URG-04LX, slit division [S]


def _all_around(num_beams: int) -> tuple[int, float, float]:
    """Beams all around, the first one behind: number, first angle and increment [rad]."""
    return num_beams, -math.pi, FULL_CIRCLE / num_beams


_PRESETS = (
    Scanner(
        "LDS-01",
        *_all_around(360),  # 1 deg [E1], 360 beams [H]
        scan_rate=5.0,  # 300 +- 10 rpm [E1]
        range_min=0.12,  # [E1]
        range_max=3.5,  # [E1]
        precision=pieces((0.12, 0.010, 0.0), (0.5, 0.0, 0.035)),  # +-10 mm, then +-3.5 % [E1]
        accuracy=pieces((0.12, 0.015, 0.0), (0.5, 0.0, 0.05)),  # +-15 mm, then +-5 % [E1]
        range_resolution=0.001,  # whole millimetres [H]
    ),
    Scanner(
        "LDS-02",
        *_all_around(460),  # 2.3 kHz [E2] at 5 Hz; [D] has the same increment
        scan_rate=5.0,  # 5 Hz or more [E2]
        range_min=0.16,  # [E2]
        range_max=8.0,  # [E2]
        # +-10 mm, +-3 %, and +-5 % which the table calls precision [E2]
        accuracy=pieces((0.16, 0.010, 0.0), (0.3, 0.0, 0.03), (6.0, 0.0, 0.05)),
        range_resolution=0.001,  # whole millimetres in the data packet [E2]
        notes=("its manual gives 1 degree, which its 2.3 kHz have at 6.4 Hz, not at 5 Hz",),
    ),
    Scanner(
        "RPLidar A1",
        *_all_around(360),  # 360 samples per scan at the typical rate [A1]
        scan_rate=5.5,  # typical [A1]
        range_min=0.15,  # white objects [A1]
        range_max=12.0,  # white objects [A1]
        precision=pieces((0.0, 0.0, 0.01)),  # < 1 % of the distance, all distances [A1]
        range_resolution=0.00025,  # quarters of a millimetre [R]
        error_notes=(
            "its data sheet gives a distance resolution, which is taken for its precision",
        ),
    ),
    Scanner(
        "RPLidar A2",
        *_all_around(800),  # 8000 samples per second, 0.45 deg at 10 Hz [A2]
        scan_rate=10.0,  # typical [A2]
        range_min=0.15,  # [R]
        range_max=12.0,  # A2M8 from R4 on [A2]
        precision=pieces((0.0, 0.0, 0.01)),  # 1 % [C]
        range_resolution=0.00025,  # quarters of a millimetre [R]
        error_notes=("its error, 1 % of the distance, is from a table by users",),
    ),
    Scanner(
        "RPLidar S2",
        *_all_around(3200),  # 0.1125 deg; 32 kHz at 10 Hz [C]
        scan_rate=10.0,  # [C]
        range_min=0.05,  # [C]
        range_max=30.0,  # [C]
        accuracy=pieces((0.0, 0.030, 0.0)),  # +-30 mm [C]
        range_resolution=0.013,  # [C]
        notes=("its numbers are from tables by users, not from its data sheet",),
    ),
    Scanner(
        "LD19",
        *_all_around(450),  # 4500 Hz, fixed, at 10 Hz [L]
        scan_rate=10.0,  # typical [L]
        range_min=0.02,  # [L]
        range_max=12.0,  # targets that reflect 70 % [L]
        range_noise=pieces((0.0, 0.010, 0.0)),  # typical standard deviation, 0.3 to 12 m [L]
        accuracy=pieces((0.0, 0.045, 0.0)),  # +-45 mm of the mean of 100, 0.3 to 12 m [L]
        range_resolution=0.015,  # [L]
        notes=("its table gives 1 degree, and 4500 Hz, which are 0.8 degrees at 10 Hz",),
        error_notes=("its noise is given from 0.3 m on, and taken below, too",),
    ),
    Scanner(
        "URG-04LX",
        num_beams=682,  # steps 44 to 725 [S]
        angle_min=(44 - 384) * HOKUYO_STEP,  # step 384 looks ahead [S]
        angle_increment=HOKUYO_STEP,
        scan_rate=10.0,  # 600 rpm [S]
        range_min=0.02,  # [S]
        range_max=5.6,  # [S]
        accuracy=pieces((0.06, 0.010, 0.0), (1.0, 0.0, 0.01)),  # +-10 mm, then 1 % to 4.095 m [P4]
        range_resolution=0.001,  # millimetres [S]
        error_notes=("its accuracy is given from 0.06 to 4.095 m, and taken outside of that, too",),
    ),
    Scanner(
        "UTM-30LX",
        num_beams=1081,  # steps 0 to 1080 [S]
        angle_min=-540 * DEGREE / 4,  # step 540 looks ahead [S]
        angle_increment=DEGREE / 4,  # 1440 steps around [S]
        scan_rate=40.0,  # 25 ms [P30]
        range_min=0.1,  # [P30]
        range_max=30.0,  # [P30]
        range_noise=pieces((0.1, 0.010, 0.0), (10.0, 0.030, 0.0)),  # sigma < 10, < 30 mm [P30]
        range_resolution=0.001,  # millimetres [S]
        error_notes=("its noise is given as a bound of the standard deviation, which is taken",),
    ),
    Scanner(
        "LMS-200",
        num_beams=361,  # at 0.5 deg [PL]
        angle_min=-90 * DEGREE,
        angle_increment=DEGREE / 2,  # [PL]
        scan_rate=37.5,  # 2 turns of 1 / 75 s each at 0.5 deg [ST]
        range_min=0.0,  # [ST]
        range_max=8.192,  # in millimetres [PL]
        range_resolution=0.001,  # [PL]
        turn_time=1 / 75,  # [ST]
        num_turns=2,  # [ST]
        notes=("a serial line of 38400 baud carries 5 of its 37.5 scans a second",),  # [PL]
    ),
    Scanner(
        "TiM571",
        num_beams=811,  # 16.2 kHz at 15 Hz, 3 per degree [T1]; 270 deg [UT]
        angle_min=-135 * DEGREE,  # [UT]
        angle_increment=DEGREE / 3,
        scan_rate=15.0,  # [T1]
        range_min=0.05,  # [UT]
        range_max=25.0,  # [UT]
        range_noise=pieces((0.0, 0.020, 0.0)),  # statistical error, 1 sigma [T2]
        accuracy=pieces((0.0, 0.060, 0.0)),  # systematic error +-60 mm [T2]
        range_resolution=0.001,  # millimetres [UT]
        error_notes=("its errors are those of TiM55x and TiM56x",),
    ),
    Scanner(
        "S300",
        num_beams=541,  # [BS]
        angle_min=-135 * DEGREE,  # 270 deg [BS]
        angle_increment=DEGREE / 2,  # [BS]
        scan_rate=25.0,  # every 40 ms by the maker's documentation [CS]; [BS] takes 80 ms
        range_min=0.1,  # [BS]
        range_max=29.5,  # [CS]
        range_resolution=0.01,  # centimetres, 13 bits [CS]
        notes=("of its two drivers one has 25 scans a second, the other 12.5; 25 are taken",),
    ),
)

NAMES = tuple(scanner.name for scanner in _PRESETS)
"""Names of all scanners."""


def preset(name: str) -> Scanner:
    """A scanner by its name; case, spaces and hyphens do not matter.

    Raises:
        ValueError: There is none of this name.
    """
    for scanner in _PRESETS:
        if _plain(scanner.name) == _plain(name):
            return scanner
    raise ValueError(f"no scanner named {name!r}; there are: {', '.join(NAMES)}")


def _plain(name: str) -> str:
    """Letters and digits of a name, lower case."""
    return re.sub(r"[^a-z0-9]", "", name.lower())
