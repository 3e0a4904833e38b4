"""Strategies of whole cases: a verb with options, right and wrong, and the files that it is given."""

from dataclasses import dataclass, field

import click
from hypothesis import strategies as st

from doe.cli import main
from doe.cli.verb import FilePath
from tests.fuzz.inputs import ARMS, PLANAR, arms, campaigns, mostly_valid, one_in, pick, studies, tables, words

LOOPS = {"loop": "pool", "pool": "loop"}  # links that lead in a circle, in every case's folder
THERE = {"there.csv": "mine\n", "folder/mine.txt": "mine\n"}  # files of the user's, in every case's folder
# of options and arguments: what makes sense, for some arm at least; of one verb: VERB.NAME
VALUES = {
    "design.runs": "12 8 20 4 3 1 100000",
    "advise.runs": "4:8 10 6:12 30:31 9:8",
    "compare.runs": "8 12 3",
    "relax.runs": "12 20",
    "discriminate.runs": "2 4",
    "solver": "exchange random ipopt analytic none",
    "relax.solver": "column_generation clarabel none",
    "solvers": "random exchange,random none",
    "criterion": "D A E I Ds Dstar d",
    "criteria": "D A D,A none",
    "subset": "length_error:1 length_error:1,joint_offset:2 joint_offset:1 translation_x:2 base.x",
    "missing": "backlash,gear_ratio joint_compliance base_offset none_such",
    "order": "given travel random best",
    "seconds": "0.1 0.3",
    "starts": "1 2",
    "grid": "2 3 9",
    "target_mm": "0.1 0.02 -1",
    "method": "linear levenberg_marquardt none",
    "payloads": "0,5 0 5,-1",
    "holdout": "more.csv",
    "links": "3 1 12 13 612,572.3 0,1",
    "dh": "6 1 12 13",
    "base_link": "link_0 link_1 none",
    "tip_link": "link_1 tool0 none",
    "replications": "1 3",
    "repeats": "1",
    "workers": "1",
    "cluster": "none tcp:/x",
    "name": "backlash backlash:2 none_such transmission_ripple",
    "topic": "formats design help none",
    "truth": "truth.toml arm.toml",
    "data": "data.csv data.csv data.csv more.csv",
    "targets": "targets.csv plan.csv",
    "files": "calibrated.toml extended.toml arm.toml plan.csv data.csv",
    "only": "lengths joint_offsets base tool effects joint_offset:2 none",
    "study": "study.toml",
    "keep": "plan.csv data.csv",
    "candidates": "candidates.csv plan.csv",
    "robot": "robot.urdf",
    "program.robot": "kuka abb fanuc ros ur none",
    "speed": "20 1 100 0",
    "settle": "2 0 -1 nan",
    "template": "arm.toml plan.csv robot.urdf",
    "seed": "0 7 12 -1 99999999999999999999",
    **dict.fromkeys(("arm", "arms", "model"), "arm.toml"),
    **dict.fromkeys(("calibrated", "prior_from"), "calibrated.toml calibrated.toml extended.toml arm.toml"),
    **dict.fromkeys(("validate.model", "compensate.model"), "calibrated.toml"),
    **dict.fromkeys(("plan", "test_poses"), "plan.csv"),
}
# options that another one asks for
NEEDS = {
    **dict.fromkeys(("design.missing", "relax.missing", "relax.runs", "score.missing"), ("--robust", "")),
    "relax.robust": ("--runs", "12"),
    "subset": ("--criterion", "Ds"),
    "test_poses": ("--criterion", "I"),
    "identify.missing": ("--library-prior", ""),
    **dict.fromkeys(("base_link", "tip_link"), ("--urdf", "robot.urdf")),
    "resume": ("--out", "out"),
}
OF_SPATIAL = {"identify.urdf", "identify.parameters"}  # options of one kind of arm alone
OF_PLANAR = {"design.discriminating"}
RARE = {"cluster": 100, "missing": 20}
RARE |= dict.fromkeys(("resume", "seed", "robust"), 12)
PICTURES = ["out.png", "out.svg", "new.png", "out.pdf"]
WRITTEN = ["out.csv", "out.toml", "out.urdf", "out.png", "out.html", "out.svg", "out"]
NO_OUTPUT = ["there.csv", "folder", "none/out.csv", "loop", "a" * 300, "arm.toml", "line\nbreak.csv", "/dev/full"]
NO_OUTPUT += ["p.gif"]
NO_INPUT = ["none.csv", "folder", "loop", "arm.toml", "plan.csv", "data.csv", "", "/dev/null", "there.csv"]
# budgets, so that a case takes little
ALWAYS = {"seconds", "workers", "advise.runs", "compare.repeats", "compare.solvers", "grid", "starts"}
WEIGHTS = {"demo": 1, "compare": 1, "study": 4, "discriminate": 2, "diagnose": 4, "advise": 3}


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
    """Of these verbs, and now and then of none; the files that the line or a study names, changed and spoilt."""
    verb = pick(draw, [verb for verb in sorted(verbs) for _ in range(WEIGHTS.get(verb, 8))])
    kind, other = draw(st.permutations(list(ARMS)))[:2]
    line = [verb, *draw(arguments(verb, kind not in PLANAR))]
    if one_in(draw, 50):
        line[draw(st.integers(0, len(line) - 1))] = draw(words)
    written = campaigns()[kind] | {"study.toml": draw(studies(kind not in PLANAR))}
    written |= {"candidates.csv": written["plan.csv"], "more.csv": written["data.csv"]}
    written["targets.csv"] = written[pick(draw, ["data.csv", "plan.csv"])]
    files, needed = {}, {*line, "robot.urdf", *(("plan.csv",) if "study.toml" in line else ())}
    needed |= {"arm.toml"} if "init" not in line or one_in(draw, 6) else set()  # which writes it
    for name in sorted(needed & written.keys()):
        text = campaigns()[other].get(name, "") if one_in(draw, 40) else written[name]
        if verb != "report" and one_in(draw, 2):  # else as armcal wrote it
            text = draw(arms(kind)) if name == "arm.toml" else draw(tables(text)) if name.endswith("csv") else text
        files[name] = draw(mostly_valid(text))
    return Case(line, files)


@st.composite
def arguments(draw: st.DrawFn, verb: str, spatial: bool) -> list[str]:
    """Words after the verb, for an arm of this kind."""
    line, needed = list[str](), dict[str, str]()
    parameters = main.commands[verb].params
    seldom = 6 if len(parameters) < 15 else 12  # so that some of the longest lines make sense too
    for parameter in parameters:
        name, full = str(parameter.name), f"{verb}.{parameter.name}"
        if full in (OF_PLANAR if spatial else OF_SPATIAL) and not one_in(draw, 20):
            continue
        wanted = parameter.required or name in ALWAYS or full in ALWAYS
        if one_in(draw, 60) if wanted else not one_in(draw, RARE.get(name, seldom)):
            continue
        if (need := NEEDS.get(full, NEEDS.get(name))) and not one_in(draw, 6):
            needed |= dict([need])
        if isinstance(parameter, click.Option) and parameter.is_flag:
            line.append(pick(draw, [*parameter.opts, *parameter.secondary_opts]))
            continue
        several = parameter.nargs == -1 and one_in(draw, 2 if name == "files" else 8)
        count = draw(st.integers(2, 6)) if several else 1
        for value in dict.fromkeys(value_of(draw, full, parameter) for _ in range(count)):
            line += [parameter.opts[0], value] if isinstance(parameter, click.Option) else [value]
    for option, value in needed.items():
        place = line.index(option) if option in line else len(line)
        line[place : place + (2 if value else 1)] = [option, *([value] if value else [])]
    return [*line, *([pick(draw, ["--none", "--json", "extra", "--help", "-"])] if one_in(draw, 60) else [])]


def value_of(draw: st.DrawFn, full: str, parameter: click.Parameter) -> str:
    """One that makes sense for an option or argument VERB.NAME, but for one in thirty."""
    name = full.rpartition(".")[2]
    if isinstance(parameter.type, FilePath) and parameter.type.written:
        return pick(draw, NO_OUTPUT if one_in(draw, 30) else PICTURES if parameter.type.picture else WRITTEN)
    if one_in(draw, 30):
        return pick(draw, NO_INPUT) if isinstance(parameter.type, click.Path) or name == "study" else draw(words)
    values = VALUES.get(full, VALUES.get(name, "")).split()
    return pick(draw, values or list(getattr(parameter.type, "choices", ())) or ["1"])
