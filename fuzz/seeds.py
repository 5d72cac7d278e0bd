"""Write the seeds of every target into its corpus, each named by its SHA-1 as libFuzzer does.

python fuzz/seeds.py [TARGET ...]
"""

from __future__ import annotations

import hashlib
import sys

import targets


def main() -> None:
    for name in sys.argv[1:] or targets.names():
        folder = targets.CORPUS / name
        folder.mkdir(parents=True, exist_ok=True)
        for data in targets.load(name).seeds():
            (folder / hashlib.sha1(data, usedforsecurity=False).hexdigest()).write_bytes(data)


if __name__ == "__main__":
    main()
