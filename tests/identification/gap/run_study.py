"""Run the blind study and print its table: python -m tests.identification.gap.run_study COUNT [CELL ...]"""

from __future__ import annotations

import sys

from identification.gap.blind_study import blind_study
from tests.identification.gap.blind import CELLS, case


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    study = blind_study(case, sys.argv[2:] or list(CELLS), count)
    print(study)  # noqa: T201
    for (hidden, named), times in study.confusion().most_common(60):
        if hidden != named:
            print(f"{times:5}  {hidden}  ->  {named}")  # noqa: T201


if __name__ == "__main__":
    main()
