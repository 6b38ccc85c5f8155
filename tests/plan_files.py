"""What is in the file of a plan, and the same changed by hand, as a script or an editor would."""

import json

import numpy as np


def contents(path):
    """Arrays by name, and the meta entries."""
    with np.load(path) as file:
        arrays = {name: file[name].copy() for name in file.files}
    return arrays, json.loads(str(arrays.pop("meta")))


def written(path, arrays, meta):
    """The path, with a file of these."""
    np.savez(path, **arrays, meta=np.array(json.dumps(meta)))
    return path
