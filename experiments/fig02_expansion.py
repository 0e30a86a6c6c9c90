"""Fig. 2 of the paper: arrival step and label of the cells around one source, and around two."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments.common import BLACK, ORANGE, SKY, Numbers, canvas, parse, save
from jaxslam.frontend.automaton import expand

STEPS = 3

# As printed: arrival and label of each cell after three steps; blank where no front has arrived
# and where fronts met. The upper three rows; the lower two mirror them.
PAPER = {
    "one": [
        "|3,v1|2,v1|3,v1|",
        "3,v1|2,v1|1,v1|2,v1|3,v1",
        "2,v1|1,v1|(v1)|1,v1|2,v1",
    ],
    "two": [
        "|3,v1|2,v1|3,v1||3,v2|2,v2|3,v2|",
        "3,v1|2,v1|1,v1|2,v1||2,v2|1,v2|2,v2|3,v2",
        "2,v1|1,v1|(v1)|1,v1||1,v2|(v2)|1,v2|2,v2",
    ],
}
SOURCES = {"one": ((5, 5), [2]), "two": ((5, 9), [2, 6])}  # shape, columns of the sources


def printed_in_paper(name: str) -> list[list[str]]:
    """Table of Fig. 2 (a), `one`, or (b), `two`."""
    upper = [row.split("|") for row in PAPER[name]]
    return upper + upper[-2::-1]


def cell_text(arrival: int, labels: int) -> str:
    """What the paper prints of a cell; `*` where fronts met, which it leaves blank."""
    if labels == 0:
        return ""
    if labels & (labels - 1):
        return "*"
    name = f"v{labels.bit_length()}"
    return f"({name})" if arrival == 0 else f"{arrival},{name}"


def table(name: str, steps: int) -> list[list[str]]:
    """The same table as computed by the automaton."""
    shape, columns = SOURCES[name]
    labels = np.zeros(shape, np.uint8)
    labels[2, columns] = 1 << np.arange(len(columns))
    diagram = expand(jnp.asarray(labels), jnp.ones(shape, bool), steps=steps)
    rows = zip(diagram.arrival.tolist(), diagram.labels.tolist(), strict=True)
    return [[cell_text(t, v) for t, v in zip(*row, strict=True)] for row in rows]


def compute() -> Numbers:
    """Both tables, and whether they equal the paper's, cell by cell."""
    tables = {name: table(name, STEPS) for name in SOURCES}
    blank = {
        name: [["" if text == "*" else text for text in row] for row in rows]
        for name, rows in tables.items()
    }
    equal = {name: rows == printed_in_paper(name) for name, rows in blank.items()}
    meets = [[i, row.index("*")] for i, row in enumerate(table("two", STEPS + 1)) if "*" in row]
    return {
        "steps": STEPS,
        **tables,
        "equal": equal,
        "meets_one_step_later": meets,
        "equal_to_paper": all(equal.values()),
    }


def draw(numbers: Numbers, path: Path) -> None:
    """Draw both tables as cells."""
    figure, axes = canvas(9.4, 3.9, 1, 2, widths=[5, 9])
    titles = {"one": "(a) one source", "two": "(b) two sources; * fronts met"}
    for axis, (name, title) in zip(axes[0], titles.items(), strict=True):
        rows = numbers[name]
        for i, row in enumerate(rows):
            for j, text in enumerate(row):
                tint = SKY if "v1" in text else ORANGE if "v2" in text else BLACK
                alpha = 0.75 if "(" in text else 0.3 if "v" in text else 0.85 if text else 0.0
                axis.fill(
                    [j, j + 1, j + 1, j], [-i, -i, -i - 1, -i - 1], color=tint, alpha=alpha, lw=0
                )
                axis.plot(
                    [j, j + 1, j + 1, j, j], [-i, -i, -i - 1, -i - 1, -i], color="0.6", lw=0.8
                )
                ink = "white" if text == "*" else "black"
                axis.text(j + 0.5, -i - 0.5, text, ha="center", va="center", color=ink, size=9)
        axis.set(aspect="equal", title=title, xlim=(-0.1, len(rows[0]) + 0.1))
        axis.set_axis_off()
    verdict = "equal to the paper's" if numbers["equal_to_paper"] else "NOT the paper's"
    figure.suptitle(
        f"Arrival step and label of each cell after {numbers['steps']} steps: {verdict}"
    )
    figure.savefig(path)


def main(argv: list[str] | None = None) -> None:
    """Run the experiment."""
    args = parse(__doc__, argv)
    save(args.out, "fig02_expansion", compute(), draw)


if __name__ == "__main__":
    main()
