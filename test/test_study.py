"""Searches that are kept in a file as they go: what is remembered, and what is refused."""

import numpy as np
import pytest

from cloth_predict.errors import FormatError
from cloth_predict.identification.optimisers.result import Plain
from cloth_predict.identification.optimisers.study import Study, StudyFile

FACTS = {'objective': 'a bowl', 'model.mass': '0.34'}


def counting():
    calls = []

    def cost(vector):
        calls.append(vector)
        return float('nan') if vector[0] > 2 else float(vector @ vector)

    return calls, Plain(cost, lambda v: (cost(v), 2 * v), 3)


def test_a_study_that_goes_on_evaluates_nothing_twice(tmp_path):
    calls, costs = counting()
    study = Study(costs, StudyFile(tmp_path / 'study'), FACTS)
    asked = [np.array([x, 0.1]) for x in (0.3, 3.0, 1 / 3)]
    first = study.values(asked), study.gradient(asked[0])
    assert len(calls) == 4
    again = Study(costs, StudyFile(tmp_path / 'study', True), FACTS)
    assert again.known == 4
    np.testing.assert_array_equal(again.values(asked), first[0])
    cost, slope = again.gradient(asked[0])
    assert len(calls) == 4
    assert cost == first[1][0]
    np.testing.assert_array_equal(slope, first[1][1])
    again.values(asked[:1])
    assert len(calls) == 5


def test_a_study_that_was_cut_off_goes_on_before_the_cut(tmp_path):
    calls, costs = counting()
    path = tmp_path / 'study'
    asked = [np.array([x, 0.1]) for x in (0.3, 0.4)]
    Study(costs, StudyFile(path), FACTS).values(asked)
    path.write_text(path.read_text()[:-7])
    again = Study(costs, StudyFile(path, True), FACTS)
    assert again.known == 1
    assert again.values(asked) == [float(v @ v) for v in asked]
    assert len(calls) == 3
    assert Study(costs, StudyFile(path, True), FACTS).known == 2


@pytest.mark.parametrize(
    ('facts', 'message'),
    [
        (FACTS | {'model.mass': '0.4'}, 'model.mass is 0.34 there, and 0.4 here'),
        (FACTS | {'seed': '1'}, 'seed is None there, and 1 here'),
        ({'objective': 'a bowl'}, 'model.mass is 0.34 there, and None here'),
    ],
)
def test_a_study_of_something_else_is_refused_by_name(tmp_path, facts, message):
    _, costs = counting()
    Study(costs, StudyFile(tmp_path / 'study'), FACTS)
    with pytest.raises(FormatError, match=f'is a study of something else: {message}'):
        Study(costs, StudyFile(tmp_path / 'study', True), facts)


def test_what_is_no_study_is_refused_by_name(tmp_path):
    _, costs = counting()
    path = tmp_path / 'study'
    for text in ('', 'no JSON', '[1]\n', '{"format": "other"}\n'):
        path.write_text(text)
        with pytest.raises(FormatError, match='is no study of a search'):
            Study(costs, StudyFile(path, True), FACTS)
    with pytest.raises(FormatError, match='study: No such file'):
        Study(costs, StudyFile(tmp_path / 'none' / 'study', True), FACTS)
    study = Study(costs, StudyFile(path), FACTS)
    study.values([np.array([0.3, 0.1])])
    whole = path.read_text()
    for line in ('{}', '["x"]', '["x", "1.0"]', '[1.0, 1.0]', '["x", 1.0, [2.0]]', '[', '\x00'):
        path.write_text(f'{whole}{line}\n["x", 1.0]\n')
        with pytest.raises(FormatError, match='line 3 is no evaluation'):
            Study(costs, StudyFile(path, True), FACTS)
    path.write_bytes(b'\xff\xfe' + whole.encode())
    with pytest.raises(FormatError, match='is no study of a search'):
        Study(costs, StudyFile(path, True), FACTS)


def test_another_search_is_noticed_at_its_first_vector(tmp_path):
    _, costs = counting()
    Study(costs, StudyFile(tmp_path / 'study'), FACTS).values([np.array([0.3, 0.1])])
    again = Study(costs, StudyFile(tmp_path / 'study', True), FACTS)
    with pytest.raises(FormatError, match='line 2 is of another search'):
        again.values([np.array([0.3, 0.2])])
    with pytest.raises(FormatError, match='line 2 is of another search'):
        again.gradient(np.array([0.3, 0.1]))  # of which there is the cost only
