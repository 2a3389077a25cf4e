"""The card of a dataset: `README.md` in its folder, in the form that hubs of datasets read."""

from pathlib import Path

import xarray as xr
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from torchsoft.datasets.config import Config
from torchsoft.datasets.files import CARD, Manifest, read_bytes, store_errors, write_bytes
from torchsoft.datasets.reader import Vouched
from torchsoft.datasets.subject import SPLITS
from torchsoft.tables import line

PAGES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
)
PAGES.filters["cell"] = lambda text: str(text).replace("|", "/")  # of a table in Markdown


def write_card(url: str) -> None:
    """Write the card of a finished dataset, unless it has one, which may have been edited."""
    if read_bytes(url, CARD) is None:
        with store_errors(url):
            write_bytes(url, CARD, card(url).encode())


def card(url: str) -> str:
    """The text of the card of a finished dataset. Raises `StoreError` for an unfinished or damaged
    one."""
    manifest, data = Manifest.read(url), Vouched(url).data(chunks=None)
    config = Config.model_validate(manifest.config)
    subject, failed = config.subject, data.failed.values.astype(bool)
    return PAGES.get_template("card.md.jinja").render(
        manifest=manifest,
        config=config,
        rig=subject.template,
        variables=subject.variables,
        example=next(iter(subject.channels), "stored_energy"),
        failed=failed.tolist(),
        by_split=by_split(data),
        reasons=sorted({line(reason, 100) for reason in data.reason.values[failed]}),
    )


def by_split(data: xr.Dataset) -> str:
    """Number of trajectories in each split."""
    return ", ".join(f"{int((data.split == name).sum())} {name}" for name in SPLITS)
