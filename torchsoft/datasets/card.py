"""The card of a dataset: `README.md` in its folder, in the form that hubs of datasets read."""

import json
from collections.abc import Iterable

import xarray as xr

from torchsoft.datasets.config import Config
from torchsoft.datasets.distributions import Choice, Distribution, Normal
from torchsoft.datasets.files import CARD, Manifest, read_bytes, store_errors, write_bytes
from torchsoft.datasets.reader import Vouched
from torchsoft.datasets.subject import SPLITS
from torchsoft.display import markdown
from torchsoft.tables import line

UNSTATED = "Not stated: say it here and at the top before others are given the data."

REASONS = 5
"""Most reasons for failures that the card lists."""


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
    example = next(iter(config.subject.signals), "stored_energy")
    return f"""\
---
pretty_name: {json.dumps(config.title, ensure_ascii=False)}
license: {config.license or "unknown"}
tags: [simulation, contact-mechanics, soft-robotics]
---

# {config.title}

{config.description}

- **Trajectories.** {counts(data)}.
- **Time.** {config.duration:g} s each, sampled every {config.sample_interval:g} s.
- **Origin.** Simulated with torchsoft {manifest.torchsoft}, seed {config.seed}, design
  `{config.method}`; no measurement, no noise. `manifest.json` holds the configuration, the commit
  and the digests.
- **Rig.** {rig(config)}
- **Licence.** {config.license or UNSTATED}

```python
from torchsoft.datasets import Trajectories, open_dataset
data = open_dataset("FOLDER")  # this one; xarray with named dimensions and units
windows = Trajectories("FOLDER", ["{example}"], split="train", window=20)  # for torch's DataLoader
```

## What differs between trajectories

{table(("number", "distribution", "unit"), drawn(config))}

## Arrays

{table(("array", "dimensions", "unit", "meaning"), arrays(config))}
"""


def counts(data: xr.Dataset) -> str:
    """Number of trajectories in all and in each split, number of failures, and their reasons."""
    failed = data.failed.values.astype(bool)
    out = f"{len(failed)} ({by_split(data)}; {int(failed.sum())} failed, their series are NaN"
    reasons = sorted({line(x, 100) for x in data.reason.values[failed]})
    more = ["..."] if len(reasons) > REASONS else []
    return "; ".join([out, *reasons[:REASONS], *more]) + ")"


def by_split(data: xr.Dataset) -> str:
    """Number of trajectories in each split."""
    return ", ".join(f"{int((data.split == name).sum())} {name}" for name in SPLITS)


def rig(config: Config) -> str:
    """Bodies, pads, contacts and actuators of the rig."""
    it = config.subject.template
    touching = (f"{one.body} on {one.pad}" for one in it.contacts.values())
    groups = {"bodies": it.bodies, "pads": it.pads, "contacts": touching, "actuators": it.actuators}
    parts = (f"{name} {', '.join(some)}" for name, some in groups.items())
    return f"`{config.rig.get('title', 'rig file')}`: {'; '.join(parts)}."


def drawn(config: Config) -> Iterable[tuple[str, ...]]:
    """Rows of the table of drawn parameters: name, distribution, unit."""
    for name, one in config.parameters.items():
        unit = "1" if one.ratio_to else config.subject.variables[name].unit
        yield f"`{name}`", distribution(one), unit
    for kind in config.kinds:
        parts = (f"`{name}` {distribution(one)}" for name, one in kind.parameters.items())
        yield f"kind `{kind.name}`, weight {kind.weight:g}", "; ".join(parts), "SI"


def distribution(one: Distribution) -> str:
    """A distribution in words."""
    span = f"{one.low:g} to {one.high:g}"
    if isinstance(one, Choice):
        text = "one of " + ", ".join(f"{x:g}" for x in one.choices)
    elif isinstance(one, Normal):
        text = f"normal, mean {one.mean:g}, standard deviation {one.sd:g}, {span}"
    else:
        text = span + (", logarithmic" if one.scale == "log" else "")
        text += ", of either sign" if one.either_sign else ""
    return text + (f", times `{one.ratio_to}`" if one.ratio_to else "")


def arrays(config: Config) -> Iterable[tuple[str, ...]]:
    """Rows of the table of arrays: name, dimensions, unit, meaning."""
    for name, one in config.subject.variables.items():
        parts = f": {', '.join(one.components)}" if one.components else ""
        yield f"`{name}`", ", ".join(one.sizes), one.unit, one.meaning + parts


def table(heading: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A table in Markdown; bars within its cells become slashes."""
    return markdown(heading, ([cell.replace("|", "/") for cell in one] for one in rows))
