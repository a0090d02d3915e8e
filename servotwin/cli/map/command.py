"""`servotwin map`: compute the missing chunks of a map, and write its numbers, table and picture."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from servotwin.analysis.maps.result import StabilityMap, write_numbers
from servotwin.analysis.maps.store import MapStore, collected, compute
from servotwin.cli.map import summary
from servotwin.cli.map.options import MapOptions
from servotwin.errors import InvalidInput
from servotwin.runtime import files
from servotwin.runtime.extras import check_extra


def stability_map(
    request: MapOptions,
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    console: Console | None = None,
) -> StabilityMap:
    """Compute a map, or its missing chunks, into the directory `out`.

    Parameters
    ----------
    request : MapOptions
    out : Path
        Made if missing. Gets settings.json and chunks/, from which an interrupted map continues; map.npz, map.csv,
        map.txt and map.png.
    workers : int, optional
        Processes on this machine; one per core by default.
    scheduler : str, optional
        Address of a Dask scheduler whose workers do the work instead.
    console : Console, optional
        Where progress and table are shown.

    Returns
    -------
    StabilityMap

    Raises
    ------
    InvalidInput
        A value out of its range, a directory that cannot be written or holds another map, a scheduler out of reach.
    KeyboardInterrupt
        Its message says how much is finished and how to continue.
    """
    console = console or Console()
    check_extra("matplotlib", "servotwin map")
    if workers is not None and scheduler is not None:
        raise InvalidInput(f"--workers {workers} and --scheduler {scheduler}: give one; a cluster has its own workers")
    settings = request.settings()
    store = MapStore(out, settings)
    compute(store, workers, scheduler, console)
    result = StabilityMap(settings, collected(store))
    write_numbers(result, out)
    files.write_text(out / "map.txt", summary.text(result))
    summary.print_summary(result, console)
    from servotwin.cli.map import figure

    path = figure.save(result, out)
    console.print(f"picture: {path}", soft_wrap=True, highlight=False)
    return result
