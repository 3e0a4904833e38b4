"""`armcal effects`: the library of physical effects, and what each needs."""

from __future__ import annotations

from doe.cli.common import Answer, CommonOptions, verb


@verb("armcal effects joint_compliance")
def command(common: CommonOptions, name: str | None = None) -> Answer:
    """The physical effects that armcal knows, and the data that each needs.

    A list of the library, or everything about the effect NAME: formula, parameters with units and typical sizes,
    which data or tables it needs and how to give them, and how it stands in an arm file. For gravity: the block of
    the arm file that some of them need. Effects of installed packages (entry points armcal.effects) are in the
    list.
    """
    from identification.documents.library import entry_document, gravity_document, library_document
    from identification.effects.catalogue import GRAVITY, entries, entry

    if name == "gravity":
        needed = [effect.name for effect in entries() if "gravity" in effect.needs]
        return Answer({"name": name, "needed_by": needed, "block": GRAVITY}, [gravity_document(needed)])
    if name is not None:
        effect = entry(name.partition(":")[0])
        return Answer(effect.to_json(), [entry_document(effect)])
    listed = entries()
    return Answer({"effects": [effect.to_json() for effect in listed]}, [library_document(listed)])
