"""One benchmark in its own process: python -m bench.worker NAME SETUP_JSON RESULT_FILE."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

from bench.entries import ENTRIES
from bench.figures import MissingError, Setup


def main() -> None:
    name, setup_json, result = sys.argv[1:]
    fields = json.loads(setup_json)
    data = fields["data"]
    setup = Setup(None if data is None else Path(data), fields["quick"])
    try:
        figures = [dataclasses.asdict(figure) for figure in ENTRIES[name].run(setup)]
    except MissingError as missing:
        content: dict = {"missing": str(missing)}
    else:
        content = {"figures": figures}
    Path(result).write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main()
