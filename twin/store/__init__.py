"""Storage of results: atomic writing of files, protected outputs, a cache, resumable work, and records of the code behind the results."""

from twin.store.arrays import ArrayFile, Layers, layers_from, layers_to, silu, through_layers
from twin.store.atomic import (
    cache_folder,
    lock_folder,
    text_file,
    write_bytes,
    write_json,
    write_npz,
    write_result,
    write_text,
    write_with,
    writing,
)
from twin.store.cache import cached_arrays
from twin.store.fingerprint import code_of, fingerprint, inputs_digest, made_by
from twin.store.output import contents, output, output_file, overwriting, writes, writes_file, written_by_us
from twin.store.resume import KEPT, Item, find_arrays, find_json, keep_arrays, keep_json, kept_arrays, kept_json, require_same_code
