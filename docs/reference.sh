#!/usr/bin/env bash
# Writes docs/reference.md from the help texts of the program: docs/reference.sh [PROGRAM]
# PROGRAM is a built picofarm [default: the debug build of this checkout]. Run it after every change of a command or
# option. An option that several commands share is described once; the others name it. Needs python3.
set -euo pipefail
cd "$(dirname "$0")"

program=$(realpath "${1:-${CARGO_TARGET_DIR:-../target}/debug/picofarm}")
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
ln -s "$program" "$folder/picofarm" # help texts name the program as it was called

env -i PATH="$PATH" HOME=/nonexistent PROGRAM="$folder/picofarm" python3 - <<'PYTHON'
import collections, os, pathlib, re, subprocess

SHARED_WORDS = 6  # an option with a shorter text is described at each command
SHARED_ARGUMENTS = 4  # an argument of this many commands is described once, at the top
FOR_CONTRIBUTORS = {"bench"}  # CONTRIBUTING.md describes it


class Command:
    """The help text of a command: description, usage, and sections of entries (signature, text)."""

    def __init__(self, *path):
        self.name = " ".join(("picofarm", *path))
        call = [os.environ["PROGRAM"], *path, "--help"]
        lines = subprocess.run(call, capture_output=True, text=True, check=True).stdout.splitlines()
        about, self.usage, self.sections, section = [], "", {}, None
        for line in lines:
            if line.startswith("Usage: "):
                self.usage = line.removeprefix("Usage: ").replace("[OPTIONS] ", "")
            elif heading := re.fullmatch(r"([A-Z][a-z ]+):", line):
                section = self.sections.setdefault(heading[1], [])
            elif section is None:
                about.append(line.strip())
            elif entry := re.fullmatch(r" {2,6}([-<\[\w].*?)(?: {2,}(.*))?", line):
                section.append((entry[1], [entry[2] or ""]))
            elif line.strip():
                section[-1][1].append(line.strip())
        self.about = " ".join(filter(None, about))
        for key, entries in self.sections.items():
            texts = [(name, join(text)) for name, text in entries]
            self.sections[key] = [e for e in texts if not re.search(r"--help|--version|^help$", e[0])]
        names = [name for name, _ in self.sections.get("Commands", []) if (*path, name)[0] not in FOR_CONTRIBUTORS]
        self.commands = [Command(*path, name) for name in names]

    def all(self):
        yield self
        for command in self.commands:
            yield from command.all()

    def entries(self, section):
        return self.sections.get(section, [])


def join(lines):
    """Joins the lines of an entry; a list of possible values becomes a sentence."""
    text, _, values = " ".join(filter(None, lines)).partition(" Possible values: - ")
    if values:
        text += ". Possible values: " + re.sub(r" - (?=[a-z0-9.]+: )", "; ", re.sub(r": {2,}", ": ", values))
    return text


def markdown(text):
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([*<])", r"\\\1", p) for p in parts)


def listing(entries):
    return "".join(f"- `{name}`: {markdown(text)}\n" if text else f"- `{name}`\n" for name, text in entries)


def flag(signature):
    return re.search(r"--[\w-]+", signature)[0]


def anchor(name):
    return f"[`{name}`](#{name.replace(' ', '-')})"


root = Command()
commands = [c for c in root.all() if c is not root]
users = collections.defaultdict(list)
for command in commands:
    for section in ("Arguments", "Options"):
        for entry in command.entries(section):
            users[section, *entry].append(command)
shared = {k for k, who in users.items() if k[0] == "Options" and len(who) > 1 and len(k[2].split()) >= SHARED_WORDS}
wealth = {c.name: sum(("Options", *e) in shared for e in c.entries("Options")) for c in commands}
home = {k: max(users[k], key=lambda c: wealth[c.name]) for k in shared}  # the first of equals
named = collections.Counter()
for (section, name, _), who in users.items():
    named[section, name.strip("<>[].")] += len(who)
pooled = sorted(
    (name, text)
    for (section, name, text), who in users.items()
    if section == "Arguments" and len(who) >= max(SHARED_ARGUMENTS, named[section, name.strip("<>[].")] / 2)
)

out = ["# Command reference\n"]
out.append("This page is made by `docs/reference.sh` from the help texts of picofarm. Do not edit it by hand.\n")
out.append("## Commands\n")
names = [n for n, _ in root.entries("Commands") if n not in FOR_CONTRIBUTORS]
out.append(", ".join(f"[{n}](#picofarm-{n})" for n in names) + "\n")
out.append("## Options of every command\n")
out.append(listing(root.entries("Global options")))
out.append("## Arguments of many commands\n")
out.append(listing(pooled))
out.append("## Exit codes\n")
out.append("".join(f"- {name}: {markdown(text)}\n" for name, text in root.entries("Exit codes")))
for command in commands:
    level = "##" if len(command.name.split()) == 2 else "###"
    out.append(f"{level} {command.name}\n")
    out.append(markdown(command.about) + "\n")
    if command.commands:
        out.append("Commands: " + ", ".join(f"[{c.name.split()[-1]}](#{c.name.replace(' ', '-')})" for c in command.commands) + "\n")
    arguments = command.entries("Arguments")
    usage = "" if command.commands else command.usage.removeprefix(command.name).replace("[OPTIONS]", "").strip()
    if len(usage.split()) > 1 or any(e in pooled for e in arguments):
        out.append(f"Arguments: `{usage}`\n")
    own = [e for e in arguments if e not in pooled]
    places = [home.get(("Options", *entry), command) for entry in command.entries("Options")]
    places = [command if places.count(place) == 1 else place for place in places]  # a single option is repeated
    elsewhere = collections.defaultdict(list)
    for place, entry in zip(places, command.entries("Options")):
        if place is command:
            own.append(entry)
        else:
            elsewhere[place.name].append(flag(entry[0]))
    if own:
        out.append(listing(own))
    for name, flags in elsewhere.items():
        out.append(f"As in {anchor(name)}: " + ", ".join(f"`{f}`" for f in flags) + "\n")
pathlib.Path("reference.md").write_text("\n".join(out))
PYTHON
echo "wrote docs/reference.md"
