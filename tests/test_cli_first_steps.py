"""What a newcomer types: nothing at all, half a word, and a first mission file."""

import json
import subprocess
from pathlib import Path

import pytest

from service.cli import build_parser
from service.cli.arguments import Parser
from service.mission_checks.zone_census import axes_deg, zone_censuses, zone_counts
from service.missions.mission import SHIPPED_FOLDER
from service.sky.zones import SearchRegion, build_zone
from service.times import parse_utc
from service.vectors import from_ra_dec
from tests.missions.stated_files import STATED_FOLDER
from tests.test_cli import COMMANDS, telemetry

SHIPPED = sorted(each.stem for each in SHIPPED_FOLDER.glob("*.toml"))


@pytest.mark.parametrize("command", ["", "catalog", "database", "mission", "simulate", "token"])
def test_a_command_without_a_command_shows_its_help(acquire, command):
    assert acquire(*command.split()) == acquire(*command.split(), "--help")


def test_a_period_may_be_named_by_the_words_of_the_api_or_by_the_old_ones():
    asked = "history --spacecraft XTE"
    new = build_parser().parse_args(f"{asked} --start 1 --end 2".split())
    old = build_parser().parse_args(f"{asked} --from 1 --to 2".split())
    assert (new.start, new.end) == (old.start, old.end) == ("1", "2")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("re", {"replay", "reprocess"}),
        ("catalog ", {"build", "import", "export", "rejected"}),
        ("advise --sp", {"--spacecraft"}),
        ("history --spacecraft XTE --format ", {"csv"}),
        ("replay pas", {"pass.ndjson"}),
        ("replay --results pas", {"pass.ndjson"}),
    ],
)
def test_bash_completes_commands_options_values_and_files(acquire, tmp_path, typed, offered):
    _, script, _ = acquire("completion", "bash")
    (tmp_path / "complete.sh").write_text(script)
    (tmp_path / "pass.ndjson").touch()
    words = " ".join(f'"{word}"' for word in ["acquire", *typed.split(" ")])
    asked = f"""
        source ./complete.sh
        COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
        $(complete -p acquire | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(
        ["bash", "-c", asked], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    found = {line.strip() for line in done.stdout.splitlines()} - {"csv;"}
    assert offered <= found, done
    if not typed.endswith(" "):
        assert all(each.startswith(typed.split()[-1]) for each in found)


@pytest.mark.parametrize("shell", ["zsh", "fish", "tcsh"])
def test_other_shells_have_their_script(acquire, shell):
    code, out, _ = acquire("completion", shell)
    assert (code, "reprocess" in out) == (0, True)


def test_every_command_that_prints_a_table_prints_it_as_json(acquire, tmp_path):
    telemetry(acquire, tmp_path / "pass.ndjson", "XTE", 3, "--nominal")
    code, out, _ = acquire("replay", "pass.ndjson", "--in-process", "--run", "r", "--json")
    told = json.loads(out)
    assert (code, told["run"], told["batches"], told["stars"]["unmatched"]) == (0, "r", 3, 0)
    code, out, _ = acquire("history", "--spacecraft", "XTE", "--run", "r", "--json")
    rows = [json.loads(line) for line in out.splitlines()]
    assert (code, len(rows)) == (0, 3)
    assert {"time", "batch", "id", "ambiguous_share"} <= set(rows[0])
    assert acquire("token", "create", "pipe", "--scope", "read")[0] == 0
    code, out, _ = acquire("token", "list", "--json")
    (token,) = json.loads(out)
    assert (code, token["name"], token["scopes"], token["state"]) == (0, "pipe", ["read"], "good")
    assert "secret" not in out
    for command in ("check", "verify"):
        code, out, _ = acquire("database", command, "--json")
        told = json.loads(out)
        assert (code, told.get("differences", told.get("faults"))) == (0, [])
    paper = ("simulate", "paper", "--table", "8", "--stars", "10", "--processes", "1")
    code, out, _ = acquire(*paper, "--json")
    assert (code, {row["table"] for row in json.loads(out)}) == (0, {"8"})


def test_commands_that_print_tables_are_known_to_have_json():
    with_json = {"advise", "database check", "database verify", "demo", "frame", "history"}
    with_json |= {"mission check", "replay", "reprocess", "simulate imaging", "simulate paper"}
    with_json |= {"mission estimate", "simulate mission", "token list", "calibrate", "smooth"}
    with_json |= {"archive", "archive verify", "archive restore", "database forget"}
    found = {name for name in {*COMMANDS, "demo"} if "--json" in _options(name)}
    assert found == with_json


def _options(command):
    parser = build_parser()
    for word in command.split():
        (commands,) = (
            each for each in parser._actions if each.dest == "==SUPPRESS==" and each.choices
        )
        parser = commands.choices[word]
    assert isinstance(parser, Parser)
    return parser._option_string_actions


# ---- mission check -----------------------------------------------------------------------------


def checked(acquire, tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    code, out, err = acquire("mission", "check", "mine.toml", "--json", "--epoch", 2000)
    assert err == ""
    told = json.loads(out)
    return code, {each["key"]: (each["level"], each["text"]) for each in told["findings"]}


def shipped(name, *changes):
    text = (STATED_FOLDER / f"{name}.toml").read_text(encoding="utf-8")
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    return text


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.slow("soho")
def test_nothing_is_unusual_in_a_shipped_mission(acquire, name):
    """And its zones are drawn with their pairs."""
    file = SHIPPED_FOLDER / f"{name}.toml"
    code, out, _ = acquire("mission", "check", file, "--picture", "zones.svg")
    assert (code, "picture: zones.svg" in out) == (0, True)
    assert "nothing is wrong, nothing is unusual" in out
    assert "pairs in a " in out
    picture = Path("zones.svg").read_text()
    assert picture.startswith("<svg ")
    # Every cell of the map.
    assert picture.count("<polygon") == 18 * 72
    if name == "soho":
        assert "pairs in a band at 90 deg" in picture
        # The two edges of the richest band.
        assert picture.count("<polyline") >= 2


@pytest.mark.parametrize(
    ("name", "change", "level", "key", "text"),
    [
        (
            "xte",
            ("radius_deg = 10.66", "radius_deg = 3.0"),
            "unusual",
            "zone.radius_deg",
            "no room",
        ),
        (
            *("xte", ("z_axis_body = [1.0, 0.0, 0.0]", "z_axis_body = [0.0, 0.0, 1.0]")),
            *("wrong", "trackers.0", "must be at right angles"),
        ),
        (
            *("xte", ("axis_body = [1.0, 0.0, 0.0]      #", "axis_body = [0.0, 0.0, 0.0] #")),
            *("wrong", "zone.axis_body", "no direction"),
        ),
        (
            *("xte", ("axis_body = [1.0, 0.0, 0.0]      #", "axis_body = [0.0, 0.0, 1.0] #")),
            *("unusual", "zone.axis_body", "no tracker looks along it"),
        ),
        (
            *("xte", ("separation_deg = 0.0066", "separation_deg = 0.0006")),
            *("unusual", "tolerances.separation_deg", "true stars will fail"),
        ),
        (
            *("xte", ("pair_separation_max_deg = 8.0", "pair_separation_max_deg = 2.0")),
            *("unusual", "tolerances.pair_separation_max_deg", "less than half"),
        ),
        (
            *("xte", ("magnitude_limit_mag = 6.5", "magnitude_limit_mag = 4.0")),
            *("unusual", "catalog.magnitude_limit_mag", "fewer than 3 stars in"),
        ),
        ("xte", ('kind = "cap"', 'kind = "cup"'), "wrong", "zone.kind", "cup"),
        ("xte", ("solver =", "solvr ="), "wrong", "solvr", "no such key; did you mean solver?"),
        (
            *("soho", ("coelevation_deg = 90.0", "coelevation_deg = 60.0")),
            *("wrong", "zone", "never in the band"),
        ),
        pytest.param(
            *("soho", ("half_width_deg = 2.1", "half_width_deg = 1.0")),
            *("unusual", "zone.half_width_deg", "not in the zone"),
            marks=pytest.mark.slow,
        ),
        (
            *("imager", ("field_of_view_radius_deg = 7.1", "field_of_view_radius_deg = 5.0")),
            *("unusual", "trackers.0.field_of_view_radius_deg", "the corner of the camera's"),
        ),
        (
            *("imager", ("psf_sigma_px = 0.9", 'psf_sigma_px = 0.9\npsf = "airy"')),
            *("unusual", "trackers.0.camera.psf", "of one colour"),
        ),
    ],
)
def test_a_slip_in_a_mission_file_is_named_by_its_key(
    acquire, tmp_path, name, change, level, key, text
):
    changes = [change]
    if key == "tolerances.separation_deg":
        # Judged only where the identifier uses it.
        changes.append(('identifier = "verified"', 'identifier = "starid"'))
    code, found = checked(acquire, tmp_path, shipped(name, *changes))
    assert key in found, found
    assert found[key][0] == level
    assert text in found[key][1]
    assert code == (1 if level == "wrong" else 0)


@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_the_counts_are_those_of_the_zones_that_are_searched(missions, sky, name):
    mission = missions[name]
    run_catalog = sky.run_catalog(mission, parse_utc("2000-01-01T12:00:00Z"))
    limit_deg = mission.tolerances.pair_separation_max_deg
    (census,) = zone_censuses(mission, run_catalog)
    ra_deg, dec_deg = axes_deg()
    for row, column in ((0, 0), (3, 40), (9, 71), (13, 20), (17, 5)):
        axis = from_ra_dec(ra_deg[column], dec_deg[row])
        region = SearchRegion(mission.zone.kind, axis, census.least_deg, census.most_deg)
        zone = build_zone(name, run_catalog, region, limit_deg, 0.0)
        assert census.stars[row, column] == len(zone.star)
        assert census.pairs[row, column] == zone.pairs.count
    alone = zone_counts(run_catalog.direction[:1], run_catalog.direction[0], 0.0, 1.0, 8.0)
    assert alone == (1, 0)
