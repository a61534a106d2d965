"""Records as a folder of pictures with metadata, which Hugging Face's ``datasets`` and its viewer read as ``imagefolder``.

``data/NNNNNN/`` has the pictures of one or more episodes and ``metadata.parquet`` with a row for each picture. Each of these folders
appears only when it is complete. ``episodes/NNNNNN.json`` lists its episodes.

The metadata are not stored as JSON lines, because pyarrow's JSON reader, which ``datasets`` uses, loses nulls at the beginning of nested
lists.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import library
from twin.frames.images import read_image, write_image
from twin.frames.tables import base_name
from twin.records.folder import PicturesWriter, card, read_facts, reading_tables, records_in, require_numbered, write_tables
from twin.records.record import CHANNELS, TIME, About, Episode, Records, RecordStep
from twin.store import write_json, write_text
from twin.store.atomic import PART, remove_parts, replace_folder

DATA, EPISODES, METADATA, CARD = "data", "episodes", "metadata.parquet", "README.md"
FRONT = "configs:\n- config_name: default\n  drop_labels: true\n  data_files: data/**\ntags:\n- tactile\n"
"""Begin of the page, by which Hugging Face reads the folder."""


class HuggingFaceWriter(PicturesWriter):
    """Writes records as pictures with ``metadata.parquet``. The pictures of episodes that are written together are in one folder."""

    FORMAT = "huggingface"
    NAMES = (DATA, EPISODES, CARD)
    FOLDERS = (DATA, EPISODES)
    LIBRARIES = ("pyarrow.parquet",)

    _next = 0  # number of the next folder

    @property
    def _part(self) -> Path:
        return self.folder / DATA / f".{self._next:06d}{PART}"

    def _begin(self) -> None:
        super()._begin()
        says = 'Pictures with metadata. In Python: `datasets.load_dataset("imagefolder", data_dir=...)`.'
        write_text(self.folder / CARD, card(self.about, FRONT, says))

    def _find(self) -> list[dict[str, Any]]:
        self._begin()
        remove_parts(self.folder / DATA)
        found = _facts_in(self.folder)
        self._next = int(found[-1][0]) + 1 if found else 0
        return [facts for _, facts in found]

    def _write_step(self, episode: Episode, step: RecordStep, number: int, k: int) -> dict[str, Any]:
        """One row of the metadata. Every row has the same keys, as the reader requires."""
        self._part.mkdir(exist_ok=True)
        name = f"episode_{number:06d}_{k:06d}.png"
        write_image(self._part / name, step.image)
        numbers = {CHANNELS[key].column: step.values[key].tolist() for key in self.about.numbers}
        head = {"file_name": name, "episode_index": number, "frame_index": k, "task": episode.task}
        return head | {TIME: float(step.time_s)} | numbers

    def _commit(self, group: list[dict[str, Any]], rows: list[Any]) -> None:
        pa = library("pyarrow")
        counted = [("file_name", pa.string()), ("episode_index", pa.int64()), ("frame_index", pa.int64()), ("task", pa.string())]
        kinds = {name: pa.list_(pa.float32()) for name in self.about.numbers}
        named = [(CHANNELS[name].column, pa.list_(kind) if len(self.about.shape(name)) == 2 else kind) for name, kind in kinds.items()]
        table = pa.Table.from_pylist(rows, pa.schema([*counted, (TIME, pa.float64()), *named]))
        write_tables(self._part / METADATA, table)
        replace_folder(self._part, self.folder / DATA / f"{self._next:06d}")
        write_json(self.folder / EPISODES / f"{self._next:06d}.json", {"episodes": group})
        self._next += 1


def huggingface_records(folder: Path) -> Records:
    """Records in a folder that ``HuggingFaceWriter`` wrote.

    Raises
    ------
    RecordError
        The folder is damaged, or another program wrote it.
    """
    found = _facts_in(folder)
    facts = [each for _, each in found]
    return records_in(
        folder, HuggingFaceWriter.FORMAT, facts, lambda about, index: partial(_steps_of, folder / DATA / found[index][0], about, index)
    )


def _steps_of(folder: Path, about: About, index: int) -> Iterator[RecordStep]:
    with reading_tables(folder) as parquet:
        for line in parquet.read_table(folder / METADATA, partitioning=None, page_checksum_verification=True).to_pylist():
            if line["episode_index"] == index:
                values = {name: np.array(line[CHANNELS[name].column], np.float32).reshape(about.shape(name)) for name in about.numbers}
                yield RecordStep(read_image(folder / base_name(line["file_name"]))[0], float(line[TIME]), values)


def _facts_in(folder: Path) -> list[tuple[str, dict[str, Any]]]:
    """Folder and facts of each episode, in their order.

    Raises
    ------
    RecordError
        One of the files that list the episodes is missing.
    """
    files = sorted((folder / EPISODES).glob("*.json"))
    require_numbered(files, "{:06d}.json".format)
    return [(path.stem, facts) for path in files for facts in read_facts(path)]
