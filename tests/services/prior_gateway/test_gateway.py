"""Priors from the curated library."""

import math
import tomllib
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np
import pytest

from prior_sg.schemas.codec import decode, encode
from prior_sg.schemas.priors import ObjectPrior, Prior, PriorRequest, Task
from prior_sg.services.prior_gateway import service
from prior_sg.services.prior_gateway.core import compose
from prior_sg.services.prior_gateway.core.compose import Library, NoPrior, with_article
from prior_sg.services.prior_gateway.core.config import Config
from prior_sg.services.prior_gateway.core.knowledge import (
    Environment,
    RegionEntry,
    Size,
    TaskEntry,
    check_environment,
    with_sizes,
)
from prior_sg.services.prior_gateway.core.matching import contains, match_environment, match_task, stems, words
from prior_sg.services.prior_gateway.outside import library
from prior_sg.services.prior_gateway.outside.archive import PREFERRED, PriorShelf
from tests.help.gateway import Gateway

LIBRARY = library.load()
CASES = [(environment, task) for environment in LIBRARY.environments for task in environment.tasks]
CASE_NAMES = [f"{environment.name}-{task.name}" for environment, task in CASES]
HOME = next(environment for environment in LIBRARY.environments if environment.name == "residential home")
OFFICE = next(environment for environment in LIBRARY.environments if environment.name == "office floor")


def asked(environment: str, task: str = "", regions: list[str] | None = None) -> Task:
    return Task(robot="spot", stamp_ns=1, environment=environment, task=task, regions=regions or [])


def prior_of(environment: str, task: str = "", regions: list[str] | None = None, cfg: Config | None = None) -> Prior:
    return LIBRARY.answer(asked(environment, task, regions), cfg or Config())


def names_of(prior: Prior) -> list[str]:
    return [region.name for region in prior.regions]


def touch(prior: Prior, one: str, other: str) -> float:
    names = names_of(prior)
    return float(prior.adjacency[names.index(one), names.index(other)])


def held(prior: Prior, region: str, thing: str) -> float:
    column = [item.name for item in prior.objects].index(thing)
    return float(prior.containment[names_of(prior).index(region), column])


# The library as a whole


def test_names_of_environments_and_their_synonyms_are_unambiguous():
    spoken = [words(name) for e in LIBRARY.environments for name in {e.name, *e.synonyms}]
    doubled = {name for name in spoken if spoken.count(name) > 1}
    shared = {
        (one.name, other.name)
        for one, other in combinations(LIBRARY.environments, 2)
        if {words(n) for n in (one.name, *one.synonyms)} & {words(n) for n in (other.name, *other.synonyms)}
    }
    assert not shared, doubled


@pytest.mark.parametrize("environment", LIBRARY.environments, ids=lambda environment: environment.name)
def test_an_environment_is_found_by_its_name_and_every_synonym(environment):
    for name in (environment.name, *environment.synonyms):
        assert match_environment(name, LIBRARY.environments) is environment, name


@pytest.mark.parametrize("environment", LIBRARY.environments, ids=lambda environment: environment.name)
def test_every_region_name_and_synonym_names_one_region(environment):
    owner: dict[tuple[str, ...], str] = {}
    for entry in environment.regions:
        for name in (entry.name, *entry.synonyms):
            assert owner.setdefault(words(name), entry.name) == entry.name, name


@pytest.mark.parametrize("environment", LIBRARY.environments, ids=lambda environment: environment.name)
def test_tasks_differ_in_how_they_divide_the_environment(environment):
    partitions = [{frozenset(group) for group in task.regions.values()} for task in environment.tasks]
    assert len(partitions) >= 2
    assert all(one != other for one, other in combinations(partitions, 2))


@pytest.mark.parametrize(("environment", "task"), CASES, ids=CASE_NAMES)
def test_every_task_gives_a_valid_prior(environment, task):
    prior = prior_of(environment.name, task.name)
    prior.check()
    assert names_of(prior) == list(task.regions)
    assert prior.provenance.source == "library"
    assert prior.provenance.detail == f"{environment.name}/{task.name}@{LIBRARY.version}"
    assert prior.answers(asked(environment.name, task.name))
    assert np.array_equal(np.diag(prior.adjacency), np.ones(len(prior.regions)))
    assert prior.containment.max(axis=1).min() >= 0.25, "every region holds something typical"
    assert len({tuple(region.phrases) for region in prior.regions}) == len(prior.regions)
    for region in prior.regions:
        assert len(set(region.phrases)) == len(region.phrases)
        assert 0 <= region.inclination_mean_rad < math.pi / 2
        assert 0.2 <= region.query_radius_m <= 5


def test_stairs_are_the_only_steep_region_of_a_home():
    prior = prior_of("house", "real-estate listing")
    steep = [region.name for region in prior.regions if region.inclination_mean_rad > math.radians(15)]
    assert steep == ["staircase"]


def test_listing_shows_the_generic_task_first():
    shown = {listing.name: listing for listing in library.environments()}
    assert list(shown) == sorted(shown)
    assert next(iter(shown["residential home"].tasks)) == "real-estate listing"
    assert shown["office floor"].regions == [entry.name for entry in OFFICE.regions]


def test_knowledge_as_expected_of_a_home():
    prior = prior_of("house", "real-estate listing")
    assert {"kitchen", "dining room", "living room", "bedroom", "bathroom"} <= set(names_of(prior))
    assert touch(prior, "kitchen", "dining room") > touch(prior, "hallway", "bedroom") - 0.1 > 0.5
    assert touch(prior, "kitchen", "bathroom") < 0.1
    assert held(prior, "kitchen", "refrigerator") > 10 * held(prior, "bathroom", "refrigerator")


def test_every_object_has_a_size_and_the_same_in_all_environments_unless_one_says_otherwise():
    seen: dict[str, tuple] = {}
    files = Path(library.__file__).parent.glob("library/*.toml")
    own = {name for file in files if file.stem != "sizes" for name in tomllib.loads(file.read_text()).get("sizes", {})}
    for environment in LIBRARY.environments:
        for task in environment.tasks:
            prior = prior_of(environment.name, task.name)
            prior.check()
            for item in prior.objects:
                assert item.size_m is not None and item.bottom_m is not None, item.name
                if item.name in own:
                    continue
                assert seen.setdefault(item.name, item.size_m) == item.size_m, item.name


def test_sizes_as_expected_of_a_home():
    sizes = {item.name: item for item in prior_of("house", "real-estate listing").objects}
    assert sizes["sofa"].size_m[0] > 2 * sizes["nightstand"].size_m[0]
    assert sizes["picture frame"].bottom_m > 1 > sizes["television"].bottom_m > sizes["sofa"].bottom_m == 0
    assert sizes["refrigerator"].size_m[2] > 1.5


def test_an_environment_may_say_otherwise_but_must_not_leave_out():
    common = {name: Size(1.0, 0.5, 0.8, 0.0) for name in ("sofa", "tap", "lid")}
    with pytest.raises(ValueError, match=r"no size of .'glass'"):
        with_sizes(small_world(), common)
    own = small_world(sizes={"sofa": Size(3.0, 0.5, 0.8, 0.0)})
    prior = small_library(with_sizes(own, common | {"glass": Size(0.1, 0.1, 0.2, 0.9, 0.2)})).answer(
        asked("pub", "drink"), Config()
    )
    found = {item.name: (item.size_m, item.bottom_m, item.size_spread) for item in prior.objects}
    assert found["sofa"][0][0] == 3.0 and found["tap"] == ((1.0, 0.5, 0.8), 0.0, 0.35)
    assert found["glass"] == ((0.1, 0.1, 0.2), 0.9, 0.2)
    with pytest.raises(ValueError, match="does not hold"):
        with_sizes(small_world(sizes={"sofá": Size(3.0, 0.5, 0.8, 0.0)}), common | {"glass": common["lid"]})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"size_m": (0.5, 0.6, 1.0)}, "longest horizontal one first"),
        ({"size_m": (0.5, 0.0, 1.0)}, "between 0 and"),
        ({"size_m": (0.5, 0.2, float("nan"))}, "between 0 and"),
        ({"size_spread": 0.0}, "spread of its size"),
        ({"bottom_m": -0.1}, "lower edge"),
    ],
)
def test_a_prior_with_an_impossible_size_is_refused(changes, says):
    prior = prior_of("house", "real-estate listing")
    broken = [msgspec.structs.replace(prior.objects[0], **changes), *prior.objects[1:]]
    with pytest.raises(ValueError, match=says):
        msgspec.structs.replace(prior, objects=broken).check()


def test_a_prior_that_knows_no_sizes_keeps_its_digest():
    bare = ObjectPrior(name="bed", phrases=["a bed"])
    assert msgspec.msgpack.encode(bare) == msgspec.msgpack.encode({"name": "bed", "phrases": ["a bed"]}), (
        "as before priors had sizes"
    )
    assert msgspec.convert({"name": "bed", "phrases": ["a bed"]}, ObjectPrior) == bare


# Merging, by numbers worked by hand


def small_world(**changes: object) -> Environment:
    regions = [
        RegionEntry(
            name="den",
            phrases=["a den with a sofa"],
            existence=6,
            objects={"sofa": 0.9},
            adjacent={"bar": 0.4},
            parent="day",
        ),
        RegionEntry(
            name="bar",
            phrases=["a bar with a tap", "bottles"],
            existence=2,
            objects={"tap": 0.5, "sofa": 0.1},
            parent="day",
            inclination_deg=20,
            inclination_std_deg=3,
            query_radius_m=1.25,
        ),
        RegionEntry(name="hatch", phrases=["a small hatch"], existence=2, objects={"lid": 0.7}, connects=0.6),
    ]
    tasks = [
        TaskEntry(name="plan", generic=True, regions={"den": ["den"], "bar": ["bar"], "hatch": ["hatch"]}),
        TaskEntry(
            name="drink",
            keywords=["serve drinks"],
            regions={"front": ["den", "bar"], "back": ["hatch"]},
            objects={"glass": {"bar": 0.8}},
        ),
    ]
    fields = {"name": "pub", "regions": regions, "tasks": tasks, "objects": {"tap": ["a beer tap"]}} | changes
    return Environment(**fields)


def small_library(environment: Environment | None = None) -> Library:
    return Library(environments=(environment or small_world(),), version="0")


def test_merged_regions_by_hand():
    check_environment(small_world())
    prior = small_library().answer(asked("pub", "drink"), Config(unlisted_containment=0.04))
    front, back = prior.regions
    # w = 0.6, 0.2 of the whole, so 3/4 and 1/4 of the merged region
    assert (front.existence, back.existence) == pytest.approx((0.8, 0.2))
    assert held(prior, "front", "sofa") == pytest.approx(0.75 * 0.9 + 0.25 * 0.1)
    assert held(prior, "front", "tap") == pytest.approx(0.75 * 0.04 + 0.25 * 0.5)
    assert held(prior, "front", "glass") == pytest.approx(0.75 * 0.04 + 0.25 * 0.8)
    assert held(prior, "back", "lid") == pytest.approx(0.7)
    assert touch(prior, "front", "back") == pytest.approx(0.6)  # the hatch connects
    # den: (0, 11.5), bar: (20, 3): mean 5; variance 3/4 (11.5^2 + 25) + 1/4 (9 + 225) = 176.4375
    assert math.degrees(front.inclination_mean_rad) == pytest.approx(5)
    assert math.degrees(front.inclination_std_rad) == pytest.approx(math.sqrt(176.4375))
    assert front.query_radius_m == pytest.approx(0.75 * 0.75 + 0.25 * 1.25)
    assert (front.parent, back.parent) == ("day", "")


def test_a_merged_region_looks_like_its_members_by_their_share():
    front = small_library().answer(asked("pub", "drink"), Config()).regions[0]
    # both phrases of the den; of the bar's three the first third
    assert front.phrases == ["a den", "a den with a sofa", "a bar"]


def test_existence_of_fixed_regions_is_half_uniform():
    prior = small_library().answer(asked("pub", "", ["den", "bar"]), Config())
    assert [region.existence for region in prior.regions] == pytest.approx([0.5 * 0.5 + 0.5 * 0.75, 0.25 + 0.125])


def test_adjacency_listed_connecting_and_default():
    prior = small_library().answer(asked("pub", "plan"), Config(unlisted_adjacency=0.05))
    assert touch(prior, "den", "bar") == pytest.approx(0.4)
    assert touch(prior, "den", "hatch") == pytest.approx(0.6)
    plain = msgspec.structs.replace(small_world().regions[2], connects=None)
    world = small_world(regions=[*small_world().regions[:2], plain])
    prior = small_library(world).answer(asked("pub", "plan"), Config(unlisted_adjacency=0.05))
    assert touch(prior, "bar", "hatch") == pytest.approx(0.05)


def test_objects_have_their_names_and_further_phrases():
    prior = small_library().answer(asked("pub", "plan"), Config(templates=["{}", "here is {}"]))
    phrases = {item.name: item.phrases for item in prior.objects}
    assert phrases["tap"] == ["a tap", "here is a tap", "a beer tap"]
    assert "glass" not in phrases, "an object of another task"


def test_query_radius_of_the_configuration_holds_everywhere():
    prior = prior_of("house", "", ["kitchen", "airlock"], cfg=Config(query_radius_m=1.5))
    assert [region.query_radius_m for region in prior.regions] == [1.5, 1.5]


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        ({"tasks": [TaskEntry(name="plan", generic=True, regions={"den": ["den"], "bar": ["bar"]})]}, "partition"),
        ({"tasks": [TaskEntry(name="plan", regions={"all": ["den", "bar", "hatch"]})]}, "generic"),
        ({"regions": [*small_world().regions, small_world().regions[0]]}, "unique"),
        ({"regions": [msgspec.structs.replace(r, objects={"x": 1.5}) for r in small_world().regions]}, "probability"),
        ({"regions": [msgspec.structs.replace(r, adjacent={"moon": 0.5}) for r in small_world().regions]}, "moon"),
        ({"regions": [msgspec.structs.replace(r, phrases=[]) for r in small_world().regions]}, "phrases"),
    ],
)
def test_contradictions_are_named(broken, says):
    with pytest.raises(ValueError, match=says):
        check_environment(small_world(**broken))


# Plain words


@pytest.mark.parametrize(
    ("text", "task"),
    [
        ("list this home for sale", "real-estate listing"),
        ("serve drinks to guests", "hospitality service"),
        ("Serving our guests a glass of wine", "hospitality service"),
        ("hospitality", "hospitality service"),
        ("find the leaking pipe and repair it", "facility maintenance"),
        ("vacuum the living room", "cleaning"),
        ("patrol the house at night", "security patrol"),
        ("assist my grandmother with her medication", "elderly care"),
    ],
)
def test_tasks_of_a_home(text, task):
    match = match_task(text, HOME)
    assert (match.task.name, match.score > 0) == (task, True), match.note


@pytest.mark.parametrize(
    ("text", "task"),
    [
        ("deliver parcels and refreshments", "deliver parcels and refreshments"),
        ("bring coffee to the meeting room", "deliver parcels and refreshments"),
        ("clean the meeting room at night", "night cleaning"),
        ("repair the air conditioning", "facility maintenance"),
        ("draw a floor plan", "floor plan"),
    ],
)
def test_tasks_of_an_office(text, task):
    assert match_task(text, OFFICE).task.name == task


def test_a_delivery_tells_the_rooms_of_an_open_office_apart():
    wanted = {"corridor", "lounge", "kitchen", "dining area", "games area", "workspace", "meeting room", "reception"}
    assert wanted <= set(names_of(prior_of("open-plan office", "deliver parcels and refreshments")))


def test_an_unknown_task_falls_back_to_the_generic_one_and_says_so():
    prior = prior_of("my flat", "compose a symphony")
    assert names_of(prior) == list(HOME.generic_task.regions)
    assert "'compose a symphony'" in prior.provenance.note
    assert "fell back to the generic task 'real-estate listing'" in prior.provenance.note
    assert "no task was given" in prior_of("my flat").provenance.note


def test_of_equal_scores_the_special_task_wins():
    generic = TaskEntry(name="plan", generic=True, keywords=["door"], regions={"all": ["den", "bar", "hatch"]})
    special = TaskEntry(name="lock up", keywords=["lock"], regions=small_world().tasks[0].regions)
    assert match_task("lock the door", small_world(tasks=[generic, special])).task is special


def test_an_unknown_environment_has_a_reason():
    with pytest.raises(NoPrior, match=r"no environment like 'coral reef'; it knows .*residential home"):
        prior_of("coral reef", "serve drinks")


def test_the_head_of_a_name_decides_the_environment():
    assert match_environment("a home office", LIBRARY.environments) is OFFICE
    assert match_environment("The small HOUSE of my parents", LIBRARY.environments) is HOME


def test_words_and_stems():
    assert words("The kid's dining-rooms, 2 boxes") == ("kid", "dining", "room", "box")
    assert stems("serving") == stems("served") == stems("serve")
    assert contains(words("a big dining room"), words("dining rooms"))
    assert not contains(words("room for dining"), words("dining room"))
    assert not contains(words("anything"), ())


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("stove", "a stove"),
        ("oven", "an oven"),
        ("stairs", "stairs"),
        ("office chair", "an office chair"),
        ("clothing", "clothing"),
        ("glass", "a glass"),
        ("utility room", "a utility room"),
        ("umbrella stand", "an umbrella stand"),
        ("x-ray machine", "an x-ray machine"),
    ],
)
def test_articles(name, phrase):
    assert with_article(name) == phrase


# Fixed vocabularies


def test_a_fixed_vocabulary_keeps_names_and_order():
    regions = ["quiet area", "games area", "sun lounge", "flux chamber", "kitchen", "dining area", "entrance"]
    prior = prior_of("small house", "tidy up", regions)
    prior.check()
    assert names_of(prior) == prior.vocabulary == regions
    assert prior.answers(asked("small house", "tidy up", regions))
    by_name = {region.name: region for region in prior.regions}
    assert "a bookcase full of books" in by_name["quiet area"].phrases
    assert by_name["quiet area"].phrases[:2] == ["a quiet area", "a reading nook"]
    assert by_name["flux chamber"].phrases == ["a flux chamber"]
    assert "'flux chamber' from its name alone" in prior.provenance.note


def test_a_name_that_nobody_knows_gets_uniform_matrices():
    prior = prior_of("house", "", ["kitchen", "flux chamber", "bedroom"])
    row = prior.containment[1]
    assert row.size and np.ptp(row) == 0, "no object speaks for or against it"
    assert np.array_equal(prior.adjacency[1], np.array([0.3, 1.0, 0.3], np.float32))
    existence = [region.existence for region in prior.regions]
    assert existence[1] == pytest.approx((existence[0] + existence[2]) / 2)


def test_a_fixed_vocabulary_reads_what_the_environment_knows():
    prior = prior_of("office", "", ["corridor", "lounge", "kitchen", "dining area", "games area"])
    expected = OFFICE.region("kitchen").adjacent
    assert touch(prior, "kitchen", "dining area") == pytest.approx(expected["dining area"])
    assert touch(prior, "kitchen", "lounge") == pytest.approx(expected["lounge"])
    assert held(prior, "games area", "football table") > 0.5 > held(prior, "kitchen", "football table")


def test_a_region_of_another_environment_is_found_there():
    prior = prior_of("house", "", ["kitchen", "meeting room", "hallway"])
    assert "conference table" in [item.name for item in prior.objects]
    # a meeting room lies at a hallway as it does at its counterpart, the corridor of an office
    assert touch(prior, "meeting room", "hallway") == pytest.approx(OFFICE.region("corridor").adjacent["meeting room"])


def test_two_names_for_one_entry_share_it_and_say_so():
    prior = small_library().answer(asked("pub", "", ["upper bar", "lower bar"]), Config())
    assert "shared with 'upper bar'" in prior.provenance.note
    assert touch(prior, "upper bar", "lower bar") == pytest.approx(Config().unknown_adjacency)
    assert prior.regions[0].phrases != prior.regions[1].phrases


def test_a_fixed_vocabulary_needs_no_known_environment():
    prior = prior_of("coral reef", "", ["kitchen", "anemone garden plot"])
    prior.check()
    assert "no environment like 'coral reef'" in prior.provenance.note


@pytest.mark.parametrize("regions", [["kitchen", "kitchen"], ["kitchen", " "], ["?!"]])
def test_a_vocabulary_must_be_distinct_words(regions):
    with pytest.raises(NoPrior, match="only once"):
        prior_of("house", "", regions)


# Identity, providers, service


def test_digest_depends_on_the_question_and_nothing_else():
    one = prior_of("house", "serve drinks to guests")
    again = Library(environments=library.load().environments, version=LIBRARY.version).answer(
        Task(robot="other", stamp_ns=99, environment="house", task="serve drinks to guests"), Config()
    )
    assert one.digest() == again.digest()
    assert encode(one) == encode(again)
    assert decode(Prior, encode(one)).digest() == one.digest()
    assert prior_of("house", "clean").digest() != one.digest()
    assert prior_of("house", "serve drinks to guests", ["kitchen"]).digest() != one.digest()


@pytest.fixture
def gateway() -> Gateway:
    return Gateway(Config(archive=""))


def test_step_publishes_one_prior_per_task(gateway):
    task = asked("house", "list this home for sale")
    [prior] = gateway.feed(task)
    assert prior.answers(task)
    [again] = gateway.feed(task)
    assert encode(again) == encode(prior)
    assert gateway.feed(prior) == []


def test_answers_by_digest_by_question_and_with_reasons(gateway):
    def ask(**fields):
        return service.answer(gateway.state, PriorRequest(**fields), gateway.cfg)

    [prior] = gateway.feed(asked("house", "clean"))
    assert encode(ask(digest=prior.digest()).priors[0]) == encode(prior)
    assert ask(environment="house", task="clean").priors[0].digest() == prior.digest()
    missing = ask(digest="00")
    assert (missing.priors, "digest 00" in missing.reason) == ([], True)
    assert gateway.feed(asked("coral reef")) == []
    for environment, pending in (("coral reef", False), ("another reef", True)):  # one given as a task, one only here
        refused = ask(environment=environment)
        assert (refused.priors, f"no environment like {environment!r}" in refused.reason) == ([], True)
        assert refused.pending == pending, "a task may still come with an imported prior"


def test_memory_forgets_the_oldest():
    gateway = Gateway(Config(remembered_priors=2, archive=""))
    digests = [gateway.feed(asked("house", task))[0].digest() for task in ("clean", "patrol", "sell")]
    assert list(gateway.state.priors) == digests[1:]
    assert set(gateway.state.answers.values()) == set(digests[1:])


def test_an_imported_prior_comes_before_the_library(tmp_path):
    cfg = Config(archive=str(tmp_path))
    other = compose.noted(prior_of("house", "clean"), "another opinion")
    PriorShelf(cfg.archive).put(other, PREFERRED)
    assert Gateway(cfg).feed(asked("house", "clean")) == [other]
    assert Gateway(cfg).feed(asked("house", "patrol"))[0].provenance.source == "library"


def test_a_damaged_archive_is_told_and_left_out(tmp_path, caplog):
    cfg = Config(archive=str(tmp_path))
    PriorShelf(cfg.archive).put(prior_of("house", "clean"), PREFERRED)
    [file] = tmp_path.glob("*/*.prior")
    file.write_bytes(file.read_bytes()[:-5])
    assert Gateway(cfg).feed(asked("house", "clean"))[0].provenance.source == "library"
    assert "cannot be read" in caplog.text
