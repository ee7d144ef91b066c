"""`chordlab batch`: every stored session below some folders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from analysis.montecarlo import available_cores
from lab.batch import analyse, per_shape, sessions_below
from lab.cli.output import JsonFlag, emit, progress_bar, say, show_table


def batch(
    roots: Annotated[list[Path], typer.Argument(metavar="ROOT...", help="Folders that hold sessions.")],
    out: Annotated[Path, typer.Option(help="Where batch.parquet and batch.csv go.")] = Path("batch"),
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one for each core.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Analyse every session below ROOT: one table, one row a session; a broken one is a row with its reason.

    Example: chordlab batch sessions --out batch
    """
    folders = sessions_below(roots)
    with progress_bar("sessions", quiet=as_json) as update:
        table = analyse(folders, workers=workers or available_cores(), progress=update)
    out.mkdir(parents=True, exist_ok=True)
    table.to_parquet(out / "batch.parquet", index=False)
    table.to_csv(out / "batch.csv", index=False)
    summary = per_shape(table)
    broken = table[table["error"] != ""]
    if as_json:
        emit(
            {
                "sessions": len(table),
                "broken": broken[["session", "error"]].to_dict(orient="records"),
                "shapes": summary.to_dict(orient="records"),
                "table": out / "batch.parquet",
            }
        )
    else:
        rows = [
            (
                str(row["shape"]),
                str(row["sessions"]),
                f"{row['right']:.0%}",
                f"{row['area_error']:+.1%} ({row['area_z']:+.1f} σ)",
                f"{row['perimeter_error']:+.1%} ({row['perimeter_z']:+.1f} σ)",
            )
            for _, row in summary.iterrows()
        ]
        show_table("Sessions by shape", ("shape", "sessions", "right", "A error", "P error"), rows)
        for _, row in broken.iterrows():
            say(f"{row['session']}: {row['error']}")
        say(str(out / "batch.parquet"))
    if len(broken) == len(table):
        raise typer.Exit(1)
