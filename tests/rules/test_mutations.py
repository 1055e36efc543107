"""Every mutation of tests/mutations.py has a place, and contract tests that exist (text only)."""

import re

from mutations import MUTATIONS, ROOT, node_of, places


def test_every_mutation_matches_exactly_one_place():
    matches = {m.name: [path.name for path, _ in places(m)] for m in MUTATIONS}
    assert {name: files for name, files in matches.items() if len(files) != 1} == {}


def test_every_mutation_changes_the_text():
    for mutation in MUTATIONS:
        for path, text in places(mutation):
            assert text != path.read_text(encoding="utf-8"), mutation.name


def test_names_of_mutations_are_unique():
    names = [mutation.name for mutation in MUTATIONS]
    assert len(set(names)) == len(names)


def test_the_tests_that_should_notice_exist():
    for mutation in MUTATIONS:
        for test in mutation.tests:
            file, _, function = node_of(test).partition("::")
            text = (ROOT / file).read_text(encoding="utf-8")
            name = re.escape(function.partition("[")[0])
            assert not name or re.search(rf"^def {name}\(", text, re.M), (
                mutation.name,
                test,
            )
