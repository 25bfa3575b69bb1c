"""Makes docs/phantoms.jpg: a row for each phantom. python examples/contact_sheet.py [--out FILE] [--photos-by rays]"""

from __future__ import annotations

import argparse
from pathlib import Path

from insideout.core.errors import InsideOutError
from insideout.core.phantoms.sheet import contact_sheet


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/phantoms.jpg"))
    parser.add_argument("--photos-by", default="cycles", choices=("cycles", "rays"))
    parser.add_argument("names", nargs="*", help="phantoms; all of them by default")
    arguments = parser.parse_args()
    try:
        print(contact_sheet(arguments.out, arguments.names, arguments.photos_by))
    except InsideOutError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
