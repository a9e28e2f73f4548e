"""What strangers put into files."""

from functools import reduce
from pathlib import Path

import yaml


class Payload:
    """Runs code when it is unpickled: it makes a file."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    def __reduce__(self):
        return (Path.touch, (self.path,))


def put(file: Path, key: str, value: object) -> None:
    """Change a value of a YAML file, of a dotted key, as a text editor would."""
    content = yaml.safe_load(file.read_text())
    *parents, last = key.split(".")
    reduce(lambda node, name: node[name], parents, content)[last] = value
    file.write_text(yaml.safe_dump(content))
