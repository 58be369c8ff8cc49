"""safetensors files written by hand, with contents that the library would refuse to write."""

import hashlib
import json

from safetensors.numpy import save as serialise


def content(tensors, metadata=None):
    """The bytes of a file whose tensors are {name: (type, shape, bytes)}."""
    header, data = {} if metadata is None else {"__metadata__": metadata}, b""
    for name, (dtype, shape, part) in tensors.items():
        header[name] = {"dtype": dtype, "shape": shape, "data_offsets": [len(data), len(data) + len(part)]}
        data += part
    return _whole(header, data)


def sealed(whole, key):
    """The bytes of a file with its checksum under ``key``-sha256 in the metadata."""
    end = 8 + int.from_bytes(whole[:8], "little")
    header, data = json.loads(whole[8:end]), whole[end:]
    header["__metadata__"][f"{key}-sha256"] = hashlib.sha256(_whole(header, data)).hexdigest()
    return _whole(header, data)


def with_arrays(arrays, key, described):
    """The bytes of a file of arrays with a description, a JSON object or a text, under ``key``."""
    text = described if isinstance(described, str) else json.dumps(described)
    return sealed(serialise(arrays, metadata={key: text}), key)


def _whole(header, data):
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data
