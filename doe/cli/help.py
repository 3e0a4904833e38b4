"""`armcal help`: the help of a verb, and the file formats."""

from __future__ import annotations

import click

from doe.cli.common import verb
from identification import InputError, nearest
from identification.document import Answer

FORMATS = "formats"
OTHER_TOPICS = dict.fromkeys(
    ("file", "files", "toml", "csv", "json", "units", "columns", "data", "measurements", "armfile", "keys"), FORMATS
)


@verb("armcal help formats")
def command(topic: str = FORMATS) -> Answer:
    """The help of a verb, or the file formats.

    Show the help of the verb TOPIC, or with `formats` all file formats and JSON keys.
    """
    context = click.get_current_context()
    assert context.parent is not None  # a verb is called by its group
    group = context.parent.command
    assert isinstance(group, click.Group)
    if topic == FORMATS:
        from rich.markdown import Markdown

        from identification.files import formats

        text = formats()
        return Answer({"topic": topic, "text": text}, [Markdown(text)])
    if topic not in group.commands:
        raise InputError(f"unknown topic {topic!r}, {nearest(topic, [FORMATS, *group.commands], OTHER_TOPICS)}")
    subcommand = group.commands[topic]
    text = subcommand.get_help(click.Context(subcommand, info_name=topic, parent=context.parent))
    return Answer({"topic": topic, "text": text}, [text])
