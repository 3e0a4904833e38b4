"""Run the blind study and print its table: python -m tests.identification.gap.run_study COUNT [CELL ...]"""

from __future__ import annotations

import sys
from collections import Counter

from identification.gap.blind_study import blind_study
from tests.identification.gap.blind import CELLS, case


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    confusion: Counter[tuple[str, str]] = Counter()
    for number, cell in enumerate(sys.argv[2:] or CELLS):
        study = blind_study(case, [cell], count)
        print("\n".join(str(study).splitlines()[number > 0 :]), flush=True)  # noqa: T201
        confusion += study.confusion()
    for (hidden, named), times in confusion.most_common(80):
        if hidden != named:
            print(f"{times:5}  {hidden}  ->  {named}")  # noqa: T201


if __name__ == "__main__":
    main()
