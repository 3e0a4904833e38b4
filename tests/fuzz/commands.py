"""Strategies of whole cases: a verb with options, right and wrong, and the files that it is given."""

from __future__ import annotations

from dataclasses import dataclass, field

import click
from hypothesis import strategies as st

from doe.cli import main
from doe.cli.verb import FilePath
from tests.fuzz.arms import ArmText, arms
from tests.fuzz.campaigns import campaigns
from tests.fuzz.tables import measurements, plans, studies, targets
from tests.fuzz.texts import mostly_valid, one_in, words

LOOPS = {"loop": "pool", "pool": "loop"}  # links that lead in a circle, in every case's folder
THERE = {"there.csv": "mine\n", "folder/mine.txt": "mine\n"}  # files of the user's, in every case's folder

CAMPAIGN = ("calibrated.toml", "extended.toml", "arm.toml", "plan.csv", "data.csv")
SAID = ("design", "score", "identify", "diagnose", "validate")
# of options and arguments: what makes sense, for some arm at least; of one verb: VERB.NAME
VALUES = {
    "design.runs": ["12", "8", "20", "4", "3", "1", "100000"],
    "advise.runs": ["4:8", "10", "6:12", "30:31", "9:8"],
    "compare.runs": ["8", "12", "3"],
    "relax.runs": ["12", "20"],
    "discriminate.runs": ["2", "4"],
    "solver": ["exchange", "random", "fedorov", "ipopt", "analytic", "exchange_ipopt", "relaxation_rounding", "none"],
    "relax.solver": ["column_generation", "clarabel", "scs", "multiplicative", "none"],
    "solvers": ["random", "exchange,random", "none"],
    "criterion": ["D", "A", "E", "I", "Ds", "Dstar", "d"],
    "criteria": ["D", "A", "D,A", "none"],
    "subset": ["length_error:1", "length_error:1,joint_offset:2", "joint_offset:1", "translation_x:2", "base.x"],
    "missing": ["backlash,gear_ratio", "joint_compliance", "base_offset", "none_such"],
    "order": ["given", "travel", "random", "best"],
    "loss": ["0.05", "0.5", "2", "-1"],
    "seconds": ["0.1", "0.3"],
    "starts": ["1", "2"],
    "draws": ["2", "1"],
    "grid": ["2", "3", "9"],
    "minimum_distance_deg": ["1", "30", "0", "1e4"],
    "uncertain": ["average", "worst", "best"],
    "target_mm": ["0.1", "0.02", "-1"],
    "method": ["linear", "gauss_newton", "paper_steps", "none"],
    "payloads": ["0,5", "0", "5,-1"],
    "holdout": ["more.csv", "0.3", "2"],
    "links": ["3", "1", "12", "13", "612,572.3", "0,1"],
    "dh": ["6", "1", "12", "13"],
    "base_link": ["link_0", "link_1", "none"],
    "tip_link": ["link_1", "tool0", "none"],
    "replications": ["1", "3"],
    "repeats": ["1"],
    "workers": ["1"],
    "cluster": ["none", "tcp:/x"],
    "name": ["backlash", "backlash:2", "none_such", "transmission_ripple"],
    "topic": ["formats", "design", "help", "none"],
    "arm": ["arm.toml"],
    "arms": ["arm.toml"],
    "model": ["arm.toml"],
    "calibrated": ["arm.toml"],
    "truth": ["truth.toml", "arm.toml"],
    "plan": ["plan.csv"],
    "data": ["data.csv", "data.csv", "data.csv", "more.csv"],
    "targets": ["targets.csv", "plan.csv"],
    "files": [
        "calibrated.toml",
        "extended.toml",
        "arm.toml",
        "plan.csv",
        "data.csv",
        *(f"{verb}.json" for verb in SAID),
    ],
    "prior_from": ["arm.toml"],
    "only": ["lengths", "joint_offsets", "base", "tool", "effects", "joint_offset:2", "none"],
    "study": ["study.toml"],
    "keep": ["plan.csv", "data.csv"],
    "candidates": ["candidates.csv", "plan.csv"],
    "test_poses": ["plan.csv"],
    "robot": ["robot.urdf"],
    "seed": ["0", "7", "12", "-1", "99999999999999999999"],
}
# options that another one asks for
NEEDS = {
    "design.draws": ("--uncertain", "average"),
    "design.loss": ("--discriminating", ""),
    "design.missing": ("--robust", ""),
    "relax.missing": ("--robust", ""),
    "relax.robust": ("--runs", "12"),
    "relax.runs": ("--robust", ""),
    "score.missing": ("--robust", ""),
    "subset": ("--criterion", "Ds"),
    "test_poses": ("--criterion", "I"),
    "identify.missing": ("--prior", ""),
    "base_link": ("--urdf", "robot.urdf"),
    "tip_link": ("--urdf", "robot.urdf"),
    "resume": ("--out", "out"),
}
OF_SPATIAL = {"identify.urdf", "identify.parameters"}  # options of one kind of arm alone
OF_PLANAR = {"design.discriminating"}
RARE = {
    "cluster": 100,
    "resume": 12,
    "seed": 12,
    "robust": 12,
    "uncertain": 20,
    "missing": 20,
    "minimum_distance_deg": 12,
}
PICTURES = ["out.png", "out.svg", "new.png", "out.pdf"]
WRITTEN = ["out.csv", "out.toml", "out.urdf", "out.png", "out.html", "out.svg", "out"]
NO_OUTPUT = [
    "there.csv",
    "folder",
    "none/out.csv",
    "loop",
    "a" * 300,
    "arm.toml",
    "line\nbreak.csv",
    "/dev/full",
    "p.gif",
]
NO_INPUT = ["none.csv", "folder", "loop", "arm.toml", "plan.csv", "data.csv", "", "/dev/null", "there.csv"]
ALWAYS = {
    "seconds",
    "workers",
    "repeats.compare",
    "solvers.compare",
    "grid",
    "starts",
}  # budgets, so that a case takes little
EXPENSIVE = {"demo": 1, "compare": 1, "study": 4, "discriminate": 2, "diagnose": 4, "advise": 3}
CHEAP = {"init", "effects", "help", "simulate", "check", "identify", "compensate", "validate", "score"}
MAKERS = {"plan.csv": plans, "candidates.csv": plans, "data.csv": measurements, "more.csv": measurements}
MAKERS |= {"targets.csv": targets, "study.toml": studies}


@dataclass(frozen=True)
class Case:
    """A command line, and the files of its folder beside `THERE` and `LOOPS`."""

    words: list[str]
    files: dict[str, str] = field(default_factory=dict)

    @property
    def verb(self) -> str:
        """The verb that it was made for."""
        return next((word for word in self.words if word in main.commands), "other")


@st.composite
def cases(draw: st.DrawFn, verbs: frozenset[str] = frozenset(main.commands)) -> Case:
    """Of these verbs, and now and then of none."""
    weighted = [verb for verb in sorted(verbs) for _ in range(EXPENSIVE.get(verb, 8))]
    verb = draw(st.sampled_from(weighted))
    arm = draw(arms())
    line = [verb, *draw(arguments(verb, arm.spatial))]
    if one_in(draw, 50):
        line[draw(st.integers(0, len(line) - 1))] = draw(words)
    if verb == "report" or one_in(draw, 6):  # what armcal itself wrote
        written = draw(campaigns(frozenset(line)))
        return Case(line, draw(files(frozenset(line), arm)) | written)
    return Case(line, draw(files(frozenset(line), arm)))


@st.composite
def files(draw: st.DrawFn, line: frozenset[str], arm: ArmText) -> dict[str, str]:
    """Those that a command line or a study names, spoilt one in seven."""
    found = {"arm.toml": draw(mostly_valid(arm.text)), **dict(arm.files)}
    if "init" in line and not one_in(draw, 6):  # which writes it
        del found["arm.toml"]
    if "robot.urdf" in line and "robot.urdf" not in found:
        found["robot.urdf"] = draw(_urdf())
    needed = {*line, *(("plan.csv",) if "study.toml" in line else ())}
    for name, maker in MAKERS.items():
        if name in needed:
            found[name] = draw(mostly_valid(draw(maker(arm))))
    if "truth.toml" in needed:
        found["truth.toml"] = draw(mostly_valid(truth(arm)))
    return found


@st.composite
def _urdf(draw: st.DrawFn) -> str:
    from tests.fuzz.arms import urdfs

    return draw(mostly_valid(draw(urdfs(3))[0]))


def truth(arm: ArmText) -> str:
    """The arm with a calibration, where it has none."""
    if "[calibration]" in arm.text or arm.spatial:
        return arm.text
    values = ", ".join(["0.0"] * len(arm.kinds))
    return f"{arm.text}\n[calibration]\nlength_errors_mm = [{values}]\njoint_offsets_deg = [{values}]\n"


@st.composite
def arguments(draw: st.DrawFn, verb: str, spatial: bool) -> list[str]:
    """Words after the verb, for an arm of this kind."""
    found: list[str] = []
    needed: dict[str, str] = {}
    parameters = main.commands[verb].params
    seldom = 6 if len(parameters) < 15 else 12  # so that some of the longest lines make sense too
    for parameter in parameters:
        name = str(parameter.name)
        if f"{verb}.{name}" in (OF_PLANAR if spatial else OF_SPATIAL) and not one_in(draw, 20):
            continue
        wanted = parameter.required or name in ALWAYS or f"{name}.{verb}" in ALWAYS
        if one_in(draw, 60) if wanted else not one_in(draw, RARE.get(name, seldom)):
            continue
        option = isinstance(parameter, click.Option)
        if (need := NEEDS.get(f"{verb}.{name}", NEEDS.get(name))) and not one_in(draw, 6):
            needed |= dict([need])
        if option and parameter.is_flag:
            found.append(draw(st.sampled_from([*parameter.opts, *parameter.secondary_opts])))
            continue
        several = parameter.nargs == -1 and one_in(draw, 2 if name == "files" else 8)
        count = draw(st.integers(2, 6)) if several else 1
        for value in dict.fromkeys(draw(value_of(verb, name, parameter)) for _ in range(count)):
            found += [parameter.opts[0], value] if option else [value]
    for option, value in needed.items():
        found = with_option(found, option, value)
    if one_in(draw, 60):
        found.append(draw(st.sampled_from(["--none", "--json", "extra", "--help", "-"])))
    return found


def with_option(line: list[str], option: str, value: str) -> list[str]:
    """A line that has the option with this value; "": a flag."""
    place = line.index(option) if option in line else len(line)
    return [*line[:place], option, *([value] if value else []), *line[place + (2 if value else 1) :]]


def value_of(verb: str, name: str, parameter: click.Parameter) -> st.SearchStrategy[str]:
    """Mostly one that makes sense."""
    if isinstance(parameter.type, FilePath) and parameter.type.written:
        return mostly(st.sampled_from(PICTURES if parameter.type.picture else WRITTEN), st.sampled_from(NO_OUTPUT))
    right = VALUES.get(f"{verb}.{name}", VALUES.get(name, list(getattr(parameter.type, "choices", ()))))
    wrong = st.sampled_from(NO_INPUT) if isinstance(parameter.type, click.Path) or name == "study" else words
    return mostly(st.sampled_from(right or ["1"]), wrong)


@st.composite
def mostly(draw: st.DrawFn, right: st.SearchStrategy[str], wrong: st.SearchStrategy[str]) -> str:
    """One that makes no sense in one of thirty."""
    return draw(wrong if one_in(draw, 30) else right)
