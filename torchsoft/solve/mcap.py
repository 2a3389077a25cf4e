"""Runs as MCAP logs: one message of JSON a sample, whose schema says unit and meaning of every
channel."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from torchsoft.extras import needed
from torchsoft.files import check_file, replacing
from torchsoft.tables import line

TOPIC = "/torchsoft"

LARGEST = 2e9
"""Size [B] of a log at the most."""

NANO = 1_000_000_000


def write_log(path: Path, data: xr.Dataset, about: Mapping[str, str]) -> None:
    """Write the variables over time of a run, with `about` as metadata. Raises `ValueError` for a
    number that is not finite."""
    writing = needed("mcap.writer", "export")
    series = {str(name): one for name, one in data.data_vars.items() if one.dims == ("time",)}
    fields = {"t": {"type": "number", "unit": "s", "description": "time since the start"}}
    for name, one in series.items():
        unit, meaning = one.attrs.get("units", "1"), one.attrs.get("long_name", "")
        fields[name] = {"type": "number", "unit": unit, "description": meaning}
    if bad := [name for name, one in series.items() if not np.isfinite(one.values).all()]:
        raise ValueError(f"`{bad[0]}` is not finite, and a log in JSON has finite numbers only")
    times = data["time"].values.tolist()
    columns = [times, *(one.values.tolist() for one in series.values())]
    with replacing(path) as partial, partial.open("wb") as file:
        writer = writing.Writer(file, enable_data_crcs=True)
        writer.start(library="torchsoft")
        schema = {"type": "object", "title": "torchsoft.Sample", "properties": fields}
        known = writer.register_schema(
            "torchsoft.Sample", "jsonschema", json.dumps(schema).encode()
        )
        channel = writer.register_channel(TOPIC, "json", known)
        writer.add_metadata("torchsoft", dict(about))
        for row in zip(*columns, strict=True):
            at = round(row[0] * NANO)
            message = json.dumps(dict(zip(fields, row)), allow_nan=False)
            writer.add_message(channel, log_time=at, publish_time=at, data=message.encode())
        writer.finish()


def read_log(path: Path) -> xr.Dataset:
    """The variables over time of a log that `write_log` wrote, or one like it. Raises `ValueError`
    for anything else, and `OSError`."""
    reading = needed("mcap.reader", "export")
    rows, fields = list[dict[str, float]](), dict[str, dict[str, str]]()
    try:
        with check_file(path, LARGEST).open("rb") as file:
            reader = reading.NonSeekingReader(file, validate_crcs=True)  # which reads all of it
            for schema, channel, message in reader.iter_messages(topics=[TOPIC]):
                if channel.message_encoding != "json" or schema is None:
                    raise ValueError(f"{TOPIC} is in {channel.message_encoding}, not in json")
                fields = fields or json.loads(schema.data)["properties"]
                rows.append(json.loads(message.data))
        if not rows:
            raise ValueError(f"it has no messages on {TOPIC}")
        columns = {name: np.array([row[name] for row in rows], float) for name in fields}
        times = columns.pop("t")
    except OSError:
        raise
    except Exception as error:  # whatever a damaged file makes a library raise
        raise ValueError(
            f"{path} is not a log of torchsoft: {line(error) or 'it was cut short'}"
        ) from None
    found = {
        name: ("time", one, {"units": fields[name].get("unit")}) for name, one in columns.items()
    }
    return xr.Dataset(found, coords={"time": times})
