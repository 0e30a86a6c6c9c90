import json
import sys

import numpy as np
import pytest

from experiments import fig02_expansion, fig06_local, fig09_global
from experiments.room_graph import reference
from jaxslam.simulation import worlds


def test_figure_2_is_written_and_equals_the_paper(tmp_path, monkeypatch):
    out = tmp_path / "new" / "folder"
    monkeypatch.setattr(sys, "argv", ["fig02_expansion", "--out", str(out), "--seed", "0"])
    fig02_expansion.main()
    numbers = json.loads((out / "fig02_expansion.json").read_text())
    assert numbers["equal_to_paper"] is True
    assert numbers["two"][2] == "2,v1 1,v1 (v1) 1,v1 * 1,v2 (v2) 1,v2 2,v2".split()
    assert numbers["meets_one_step_later"] == [[i, 4] for i in range(5)]
    picture = (out / "fig02_expansion.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 5000


def test_a_wrong_table_is_reported(monkeypatch):
    monkeypatch.setattr(fig02_expansion, "STEPS", 2)
    assert fig02_expansion.compute()["equal_to_paper"] is False


def test_the_folder_for_the_results_must_be_named(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["fig02_expansion"])
    with pytest.raises(SystemExit):
        fig02_expansion.main()
    assert "--out" in capsys.readouterr().err


@pytest.mark.slow
def test_both_labels_keep_what_the_paper_says_of_corridors():
    """Figure 6: lines in the middle, the bend, the shift, and no false branch."""
    claims = fig06_local.compute()["claims"]
    assert set(claims) == {"runs", "codes"}
    for mode, of_mode in claims.items():
        assert {type(x) for x in of_mode.values()} == {bool, float}
        assert all(x for x in of_mode.values() if isinstance(x, bool)), (mode, of_mode)


@pytest.mark.slow
def test_ten_scans_of_a_room_give_the_voronoi_graph_of_its_walls():
    """Figures 8 and 9, with a draw of the noise that the picture is not of."""
    walls = np.asarray(worlds.named(fig09_global.WORLD).walls)
    maps, *_ = fig09_global.explore(worlds.scan_poses(fig09_global.WORLD), walls, seed=3)
    result = fig09_global.compare(maps[-1], reference(walls))
    assert fig09_global.equal(result), result
    assert result["worst_node_error_m"] < fig09_global.NEAR
