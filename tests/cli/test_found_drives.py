"""`jaxslam simulate` with random buildings and with drives that are found."""

import numpy as np
import pytest

from jaxslam.cli.world_options import read_building
from jaxslam.io.errors import InputError
from jaxslam.simulation import patrols, worlds
from jaxslam.simulation.buildings import building


def test_a_random_building_is_patrolled_and_says_so():
    given = read_building("random:1:12.5x10")
    walls = building(1, (12.5, 10.0)).world.walls
    np.testing.assert_array_equal(given.world.walls, walls)
    np.testing.assert_allclose(given.path, patrols.patrol(walls).path)
    assert given.notes[0].startswith("patrol of ") and given.notes[1].startswith("chosen: ")


def test_a_drive_is_found_in_a_world_with_and_without_its_own():
    for world in ("office", "fig07"):
        given = read_building(world, drive="route")
        np.testing.assert_allclose(given.path, patrols.route(worlds.named(world).walls).path)


def test_a_drive_is_found_in_a_file(tmp_path):
    rows = [",".join(map(str, wall)) for wall in worlds.named("fig07").walls.tolist()]
    (tmp_path / "random_plan.csv").write_text("\n".join(["x1,y1,x2,y2", *rows]))
    given = read_building(str(tmp_path / "random_plan.csv"), drive="patrol")
    assert given.notes[-2].startswith("patrol of ") and len(given.path) > 100
    with pytest.raises(InputError, match="add --drive patrol, or --path FILE"):
        read_building(str(tmp_path / "random_plan.csv"))


@pytest.mark.parametrize(
    "world, options, line",
    [
        (
            "random:1",
            {"path": "a.csv", "drive": "route"},
            "--drive: is not for a drive that --path",
        ),
        ("random:1:9x9", {}, "--world: size is 9 x 9 m"),
        ("random:x", {}, "--world: world 'random:x' is not of the form random:SEED"),
        ("random", {}, "--world: no world named 'random'; .*random:SEED"),
        ("fig06a", {"drive": "patrol"}, "--drive: walls enclose no free space"),
    ],
)
def test_what_is_not_possible_is_refused(world, options, line):
    with pytest.raises(InputError, match=line):
        read_building(world, **options)
