"""Printed summaries, and the exit code of a run whose map contradicts itself."""

import pytest

from jaxslam.cli import main, summaries

NUMBERS = {
    "path_length_m": 12.0,
    "landmarks": 5,
    "matches": 2.0,
    "seconds": {"run": 1.0, "compile": 2.0},
}


def consistency(num_warnings):
    warnings = [
        {"first_scan": k, "last_scan": k + 1, "reason": f"scans {k}-{k + 1} near (0.0, 1.0) m"}
        for k in range(num_warnings)
    ]
    return {
        "explained": 0.97,
        "walls_median_m": 0.02,
        "walls_p90_m": 0.1,
        "warnings": warnings,
    }


@pytest.mark.parametrize("num_warnings, lines", [(0, 0), (2, 2), (9, summaries.MAX_WARNINGS + 1)])
def test_each_warning_is_a_line_but_not_too_many(num_warnings, lines, capsys, tmp_path):
    numbers = NUMBERS | {"map_consistency": consistency(num_warnings)}
    summaries.print_summary(numbers, "a log", tmp_path)
    said = capsys.readouterr().out
    assert said.count("WARNING: ") == lines
    assert "97.0%     0.020" in said
    assert ("scans 0-1 near" in said) == (num_warnings > 0)
    assert ("4 more parts" in said) == (num_warnings == 9)


def test_a_map_without_a_second_visit_has_no_distance_of_walls(capsys, tmp_path):
    numbers = NUMBERS | {"map_consistency": consistency(0) | {"walls_median_m": None}}
    summaries.print_summary(numbers, "a log", tmp_path)
    assert "97.0%\n" in capsys.readouterr().out


@pytest.mark.parametrize("returned, code", [(None, 0), (0, 0), (3, 3)])
def test_the_exit_code_is_that_of_the_command(returned, code, monkeypatch):
    def run() -> int | None:
        """Run."""
        return returned

    monkeypatch.setattr(main, "function_of", {"run": run}.get)
    assert main.main(["run"]) == code
