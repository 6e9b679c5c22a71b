"""Every public file against an independent dense reading; statements, round trips and refusals one by one."""

from __future__ import annotations

import csv
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from jaxpomdp.envs.pomdp_file import PomdpError, read_pomdp, write_pomdp
from jaxpomdp.envs.pomdp_lexer import ANY
from jaxpomdp.envs.pomdp_rows import scaled
from jaxpomdp.envs.pomdp_tables import ParsedPOMDP, RewardRules
from tests.oracles.pomdp_dense import read_dense

REFUSED = {"gym-pomdps/floatreset.v0.pomdp": (41, 1, "'OO'")}
HEAD = "discount: 0.9\nstates: a b c\nactions: go stay\nobservations: 2\n"
BODY = "T: * identity\nO: * uniform\n"


def rows(shared_dir):
    with (shared_dir / "data/pomdp/STATS.tsv").open() as file:
        return list(csv.DictReader(file, delimiter="\t"))


def same(x: ParsedPOMDP, y: ParsedPOMDP) -> bool:
    """Equal to the last bit, notes aside."""
    plain = ("states", "actions", "observations", "discount", "values", "end_states")
    pairs = [(x.start, y.start), (x.rewards.index, y.rewards.index), (x.rewards.value, y.rewards.value)]
    for left, right in zip(
        x.transitions + x.observation_probs, y.transitions + y.observation_probs, strict=True
    ):
        pairs += [(left.toarray(), right.toarray())]
    return all(getattr(x, f) == getattr(y, f) for f in plain) and all(np.array_equal(p, q) for p, q in pairs)


def dense(matrices):
    return np.stack([matrix.toarray() for matrix in matrices])


def dense_rewards(parsed):
    a, n, o = parsed.num_actions, parsed.num_states, parsed.num_observations
    return parsed.rewards.lookup(*np.ogrid[:a, :n, :n, :o])


def test_every_file_agrees_with_its_published_numbers(shared_dir):
    seen = 0
    for row in rows(shared_dir):
        path = shared_dir / "data/pomdp" / row["file"]
        if row["file"] in REFUSED:
            line, column, word = REFUSED[row["file"]]
            with pytest.raises(PomdpError, match=word) as refused:
                read_pomdp(path)
            assert (refused.value.line, refused.value.column) == (line, column)
            continue
        parsed = read_pomdp(path)
        sizes = parsed.num_states, parsed.num_actions, parsed.num_observations
        assert sizes == (int(row["S"]), int(row["A"]), int(row["Z"])), row["file"]
        assert parsed.discount == (float(row["discount"]) if row["discount"] else None), row["file"]
        assert parsed.values == row["values"].rstrip("s"), row["file"]
        reward_range = [parsed.rewards.value.min(), parsed.rewards.value.max()]
        np.testing.assert_allclose(reward_range, [float(x) for x in row["rewards"].split("..")], rtol=1e-5)
        uniform = np.array_equal(parsed.start, np.full(parsed.num_states, 1 / parsed.num_states))
        assert uniform or row["start"] != "uniform(default)", row["file"]
        positive = parsed.start[parsed.start > 0]
        assert row["start"] not in ("include", "statelist") or np.ptp(positive) == 0, row["file"]
        assert same(read_pomdp(write_pomdp(parsed)), parsed), row["file"]
        seen += 1
    assert seen == len(rows(shared_dir)) - len(REFUSED)


def test_every_file_agrees_with_a_dense_reading(shared_dir):
    for row in rows(shared_dir):
        if row["file"] in REFUSED or row["S"] == "256":
            continue
        path = shared_dir / "data/pomdp" / row["file"]
        parsed, oracle = read_pomdp(path), read_dense(path.read_text())
        np.testing.assert_allclose(parsed.start, oracle.start, atol=1e-15, err_msg=row["file"])
        np.testing.assert_allclose(dense(parsed.transitions), oracle.trans, atol=1e-15, err_msg=row["file"])
        np.testing.assert_allclose(
            dense(parsed.observation_probs), oracle.obs, atol=1e-15, err_msg=row["file"]
        )
        np.testing.assert_array_equal(dense_rewards(parsed), oracle.reward, err_msg=row["file"])
        expected = np.einsum("ast,ato,asto->as", oracle.trans, oracle.obs, oracle.reward)
        np.testing.assert_allclose(parsed.expected_rewards(), expected, atol=1e-9, err_msg=row["file"])


def test_the_dense_reading_tells_a_reader_in_which_the_first_line_wins():
    text = HEAD + BODY + "R: * : a : * : * 1\nR: go : a : b : * 2\nR: * : * : * : 1 3\n"
    parsed, oracle = read_pomdp(text), read_dense(text)
    broken = RewardRules(parsed.rewards.index[::-1], parsed.rewards.value[::-1])
    every = np.ogrid[:2, :3, :3, :2]
    np.testing.assert_array_equal(parsed.rewards.lookup(*every), oracle.reward)
    assert not np.array_equal(broken.lookup(*every), oracle.reward)


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("", [1 / 3, 1 / 3, 1 / 3]),
        ("start: uniform", [1 / 3, 1 / 3, 1 / 3]),
        ("start: 0.25 0.25\n 0.5", [0.25, 0.25, 0.5]),
        ("start: b", [0, 1, 0]),
        ("start: 2", [0, 0, 1]),
        ("start: a c", [0.5, 0, 0.5]),
        ("start include: b c", [0, 0.5, 0.5]),
        ("start exclude : b", [0.5, 0, 0.5]),
        ("start include: *", [1 / 3, 1 / 3, 1 / 3]),
    ],
)
def test_start(statement, expected):
    np.testing.assert_allclose(read_pomdp(f"{HEAD}{statement}\n{BODY}").start, expected, atol=1e-15)


def test_later_lines_override_earlier_ones_of_every_arity():
    text = (
        HEAD + "start: a\nO: * uniform\nT: * uniform\nT: go identity\nT: go : b reset\nT: go : c\n0 0.5 0.5\n"
    )
    text += "T: stay : *\n1 0 0\nT: stay : a : * 0\nT: stay : a : b 1.0\n"
    go, stay = dense(read_pomdp(text).transitions)
    np.testing.assert_array_equal(go, [[1, 0, 0], [1, 0, 0], [0, 0.5, 0.5]])
    np.testing.assert_array_equal(stay, [[0, 1, 0], [1, 0, 0], [1, 0, 0]])


def test_reward_rows_and_matrices():
    text = HEAD + BODY + "R: go : a : b\n1 2\nR: stay : a\n1 2 3 4 5 6\nR: * : b : * : 1 7\n"
    reward = dense_rewards(read_pomdp(text))
    np.testing.assert_array_equal(reward[0, 0], [[0, 0], [1, 2], [0, 0]])
    np.testing.assert_array_equal(reward[1, 0], [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(reward[:, 1], np.broadcast_to([0, 7], (2, 3, 2)))


def test_words_may_wrap_and_names_may_look_like_keywords():
    text = "discount\n:\n0.9 values: costs states:\n# four\n T # one\n O E\n start\n"
    text += "actions: R observations: x T: R\nidentity O:R:T:x 1 O: R : * : x 1.0 R: R : E : * : * 5 E: O\n"
    parsed = read_pomdp(text)
    assert (parsed.states, parsed.actions, parsed.values) == (("T", "O", "E", "start"), ("R",), "cost")
    assert parsed.end_states == (1,)
    np.testing.assert_array_equal(parsed.expected_rewards(), [[0, 0, 5, 0]])


def test_actions_with_the_same_table_share_it():
    parsed = read_pomdp(HEAD + BODY)
    assert parsed.observation_probs[0] is parsed.observation_probs[1]
    assert "O: * : a" in write_pomdp(parsed)


def test_rounded_rows_are_scaled_with_a_note_and_wrong_ones_refused():
    rounded = read_pomdp(HEAD + BODY + "T: go : b\n0.333333 0.333333 0.333333\n")
    np.testing.assert_allclose(rounded.transitions[0].toarray()[1], 1 / 3, atol=1e-15)
    assert [(note.line, note.column) for note in rounded.notes] == [(7, 1)]
    text = HEAD + BODY + "O: stay : c : 0 0.4\n"
    with pytest.raises(PomdpError, match=r"O : stay : c sum to 0\.9, expected 1") as refused:
        read_pomdp(text)
    assert refused.value.line == 7
    mended = read_pomdp(text, mend=True)
    np.testing.assert_allclose(mended.observation_probs[1].toarray()[2], [4 / 9, 5 / 9])
    assert mended.notes[0].line == 7


def test_a_matrix_row_that_is_wrong_is_named_by_its_own_line():
    with pytest.raises(PomdpError, match="T : go : c") as refused:
        read_pomdp(HEAD + BODY + "T: go\n1 0 0\n0 1 0\n0 0 0.8\n")
    assert refused.value.line == 10


def test_rows_never_given():
    text = HEAD + "O: * uniform\nT: go identity\n"
    with pytest.raises(PomdpError, match="T : stay : a are never given"):
        read_pomdp(text)
    mended = read_pomdp(text, mend=True)
    np.testing.assert_allclose(mended.transitions[1].toarray(), 1 / 3)
    ended = read_pomdp(text + "T: stay : a : b 1\nT: stay : b : a 1\nE: c\n")
    np.testing.assert_array_equal(ended.transitions[1].toarray()[2], [0, 0, 1])


@pytest.mark.parametrize(
    ("text", "line", "column", "message"),
    [
        ("discount: 1.5\n", 1, 11, "must lie in"),
        ("discount 0.9\n", 1, 10, "expected ':' after 'discount'"),
        ("discount:\n", 1, 10, "a number, got the end of the file"),
        ("values: money\n", 1, 9, "reward or cost"),
        ("states: a b a\n", 1, 13, "different names"),
        ("states: 0\n", 1, 10, "a number above 0"),
        ("states: 2\nstates: 3\n", 2, 1, "given twice"),
        ("states: 2\nT: 0 : 0 : 0 1\n", 2, 2, "actions must be given before"),
        ("states: 2\nE: 5\n", 2, 4, "2 states"),
        (HEAD, 4, 16, "never given"),
        (HEAD + "start: 0.5 0.5 0.5\n", 5, 16, "sum to 1"),
        (HEAD + "start: 0.5 0.5\n", 5, 15, "expected 3 numbers for start, got 2"),
        (HEAD + "start: a d\n", 5, 10, "got 'd'"),
        (HEAD + "start exclude: *\n", 5, 16, "at least one state"),
        (HEAD + "T: go : b reset\nstart: a\n", 6, 1, "before the first 'reset'"),
        (HEAD + "T: jump identity\n", 5, 4, "2 actions (go, stay), got 'jump'"),
        (HEAD + "T: go : a : 3 1\n", 5, 13, "3 states (a, b, c), got '3'"),
        (HEAD + "T: go : a : b 1.5\n", 5, 15, "must lie in [0, 1]"),
        (HEAD + "T: go : a\n0.5 -0.5 1\n", 6, 5, "must lie in [0, 1]"),
        (HEAD + "T: go\n1 0 0\n0 1 0\nO: * uniform\n", 8, 1, "expected 9 numbers for T, got 6 and then 'O'"),
        (HEAD + "T: go\n1 0 0\n0 1 nan 0 0 1\n", 7, 5, "got 5 and then 'nan'"),
        (HEAD + "T: go identity 3\n", 5, 16, "too many numbers"),
        (HEAD + "R: go : a : a : 0 x\n", 5, 19, "a reward, a number, got 'x'"),
        (HEAD + "R: go 5\n", 5, 7, "expected ':' after 'go'"),
        (HEAD + "O: go reset\n", 5, 7, "expected 6 numbers for O"),
        (HEAD + BODY + "stop here\n", 7, 1, "expected one of discount"),
    ],
)
def test_refusals_name_the_place(text, line, column, message):
    with pytest.raises(PomdpError) as refused:
        read_pomdp(text)
    assert (refused.value.line, refused.value.column) == (line, column), refused.value
    assert message in refused.value.message


def test_empty_and_missing_files(tmp_path):
    with pytest.raises(PomdpError, match="states must be given"):
        read_pomdp("\n")
    with pytest.raises(FileNotFoundError):
        read_pomdp(tmp_path / "none.POMDP")


def test_a_file_is_read_in_either_encoding(tmp_path):
    path = tmp_path / "x.POMDP"
    path.write_bytes(("# caf\xe9\r\n" + (HEAD + BODY).replace("\n", "\r\n")).encode("latin-1"))
    assert read_pomdp(str(path)).states == ("a", "b", "c")


def test_names_that_cannot_be_written_are_refused():
    parsed = read_pomdp(HEAD + BODY)
    with pytest.raises(ValueError, match="states must be names without space"):
        write_pomdp(ParsedPOMDP(**{**vars(parsed), "states": ("a b", "c", "d")}))


@st.composite
def models(draw):
    num_states, num_actions, num_observations = (draw(st.integers(1, 6)) for _ in range(3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def table(width):
        weights = rng.random((num_states, width)) * (rng.random((num_states, width)) < 0.6)
        weights[np.arange(num_states), rng.integers(width, size=num_states)] += 0.1
        return scaled(csr_array(weights))

    count = draw(st.integers(0, 6))
    sizes = (num_actions, num_states, num_states, num_observations)
    index = np.stack([rng.integers(ANY, size, count) for size in sizes], axis=-1)
    start = rng.dirichlet(np.ones(num_states))
    names = draw(st.sampled_from([lambda i: str(i), lambda i: f"x-{i}"]))
    return ParsedPOMDP(
        *(tuple(names(i) for i in range(size)) for size in (num_states, num_actions, num_observations)),
        draw(st.sampled_from([None, 0.95, 1 / 3])),
        draw(st.sampled_from(["reward", "cost"])),
        start / start.sum(),
        tuple(table(num_states) for _ in range(num_actions)),
        tuple(table(num_observations) for _ in range(num_actions)),
        RewardRules(index, rng.normal(size=count)),
        tuple(draw(st.sets(st.integers(0, num_states - 1), max_size=2))),
    )


@settings(max_examples=40, deadline=None)
@given(models())
def test_a_written_file_reads_back_to_the_last_bit(model):
    assert same(read_pomdp(write_pomdp(model)), model)


def test_a_thousand_states_are_read_in_seconds_and_sparsely():
    lines = ["discount: 0.95\nstates: 1000\nactions: 4\nobservations: 20\nO: * uniform\n"]
    for action in range(4):
        for state in range(1000):
            lines += [f"T: {action} : {state} : {(state + i) % 1000} 0.25\n" for i in range(4)]
            lines.append(f"R: {action} : {state} : {(state + 1) % 1000} : * {state}\n")
    begin = time.perf_counter()
    parsed = read_pomdp("".join(lines))
    assert time.perf_counter() - begin < 5
    assert all(matrix.nnz == 4000 for matrix in parsed.transitions)
    np.testing.assert_allclose(parsed.expected_rewards()[2], np.arange(1000) / 4)
