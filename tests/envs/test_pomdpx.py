"""The .pomdpx reader against the same worlds as .POMDP files, RockSample by its rules, and small texts."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from jaxpomdp.envs.pomdp_file import PomdpError, read_pomdp, write_pomdp
from jaxpomdp.envs.pomdpx import read_pomdpx

TWINS = {"Tiger": "tiger.95.POMDP", "Hallway": "hallway.POMDP", "Hallway2": "hallway2.POMDP"}


def dense(matrices):
    return np.stack([matrix.toarray() for matrix in matrices])


@pytest.mark.parametrize("name", TWINS)
def test_agrees_with_the_same_world_as_a_pomdp_file(shared_dir, name):
    folder = shared_dir / "data/pomdp"
    parsed, twin = read_pomdpx(folder / f"pomdpx/{name}.pomdpx"), read_pomdp(folder / TWINS[name])
    assert parsed.discount == twin.discount
    np.testing.assert_array_equal(parsed.start, twin.start)
    np.testing.assert_array_equal(dense(parsed.transitions), dense(twin.transitions))
    np.testing.assert_array_equal(dense(parsed.observation_probs), dense(twin.observation_probs))
    np.testing.assert_allclose(parsed.expected_rewards(), twin.expected_rewards(), atol=1e-12)


def test_rock_sample_by_its_rules(shared_dir):
    parsed = read_pomdpx(shared_dir / "data/pomdp/pomdpx/RockSample_7_8.pomdpx")
    assert (parsed.num_states, parsed.num_actions, parsed.num_observations) == (50 * 2**8, 13, 2 * 50)
    start = [parsed.states[s] for s in np.flatnonzero(parsed.start)]
    assert all(name.startswith("s03_") for name in start)
    assert len(start) == 2**8
    bad, good = "_".join(["bad"] * 8), "_".join(["good"] * 8)
    moves = parsed.transitions[parsed.actions.index("amn")]
    assert moves[[parsed.states.index(f"s03_{good}")]].indices.tolist() == [
        parsed.states.index(f"s04_{good}")
    ]
    rewards = parsed.expected_rewards()
    sample, sense = parsed.actions.index("as"), parsed.actions.index("ac0")
    assert rewards[sample, parsed.states.index(f"s20_{good}")] == 10
    assert rewards[sample, parsed.states.index(f"s20_{bad}")] == -10
    on_rock = parsed.observation_probs[sense][[parsed.states.index(f"s20_{good}")]].tocoo()
    assert [parsed.observations[o] for o in on_rock.col] == ["ogood_s20"]


VARIABLES = """<Variable>
<StateVar vnamePrev="x0" vnameCurr="x1" fullyObs="true"><ValueEnum>l r</ValueEnum></StateVar>
<StateVar vnamePrev="y0" vnameCurr="y1"><NumValues>3</NumValues></StateVar>
<ObsVar vname="o"><ValueEnum>no yes</ValueEnum></ObsVar>
<ActionVar vname="a"><NumValues>2</NumValues></ActionVar>
<RewardVar vname="r"/>
</Variable>"""


def conditional(var, parents, parameter):
    return f"<CondProb><Var>{var}</Var><Parent>{parents}</Parent>{parameter}</CondProb>"


def table(*entries, tag="ProbTable"):
    inside = "".join(f"<Entry><Instance>{i}</Instance><{tag}>{v}</{tag}></Entry>\n" for i, v in entries)
    return f'<Parameter type="TBL">{inside}</Parameter>'


def diagram(inside):
    return f'<Parameter type="DD"><DAG>{inside}</DAG></Parameter>'


X_MOVES = table(("* - -", "identity"), ("a1 l -", "0.25 0.75"))
Y_MOVES = table(("* - -", "identity"), ("r * *", "0 0 1"))
SEEING = table(("* * *", "uniform"), ("a0 s2 -", "0 1"))


def text(*, x_moves=None, y_moves=None, seeing=None, rewards=None, discount="0.9"):
    x_moves = x_moves or conditional("x1", "a x0", X_MOVES)
    y_moves = y_moves or conditional("y1", "x1 y0", table(("l - -", "identity"), ("r * -", "0 0 1")))
    seeing = seeing or conditional("o", "a y1", SEEING)
    rewards = rewards or (
        f"<Func><Var>r</Var><Parent>a x0</Parent>{table(('a1 l', '2'), tag='ValueTable')}</Func>"
        f"<Func><Var>r</Var><Parent>y1 o</Parent>{table(('s2 -', '1 3'), tag='ValueTable')}</Func>"
    )
    return f"""<?xml version="1.0" encoding="ISO-8859-1"?>
<pomdpx><Discount>{discount}</Discount>{VARIABLES}
<InitialStateBelief>{conditional("x0", "null", table(("-", "0.5 0.5")))}
{conditional("y0", "x0", table(("l -", "1 0 0"), ("r -", "uniform")))}</InitialStateBelief>
<StateTransitionFunction>{y_moves}
{x_moves}</StateTransitionFunction>
<ObsFunction>{seeing}</ObsFunction>
<RewardFunction>{rewards}</RewardFunction></pomdpx>"""


def test_a_factored_model_against_sums_over_its_factors():
    parsed = read_pomdpx(text())
    assert parsed.states == tuple(f"{x}_s{y}" for x in "lr" for y in range(3))
    assert parsed.observations == ("no_l", "no_r", "yes_l", "yes_r")
    np.testing.assert_allclose(parsed.start, [0.5, 0, 0, 1 / 6, 1 / 6, 1 / 6])
    x_moves = np.array([np.eye(2), [[0.25, 0.75], [0, 1]]])
    y_moves = np.array([np.eye(3), np.eye(3)[[2, 2, 2]]])
    seeing = np.full((2, 3, 2), 0.5)
    seeing[0, 2] = [0, 1]
    for a, x, y in itertools.product(range(2), range(2), range(3)):
        joint = np.einsum("i,ij->ij", x_moves[a, x], y_moves[:, y]).ravel()
        np.testing.assert_allclose(parsed.transitions[a].toarray()[3 * x + y], joint)
        both = np.einsum("o,x->ox", seeing[a, y], np.eye(2)[x]).ravel()
        np.testing.assert_allclose(parsed.observation_probs[a].toarray()[3 * x + y], both)
        arrives = joint.reshape(2, 3)[:, 2].sum()
        paid = 2 * (a == 1 and x == 0) + arrives * seeing[a, 2] @ [1, 3]
        np.testing.assert_allclose(parsed.expected_rewards()[a, 3 * x + y], paid)


def test_a_flattened_model_is_written_as_a_pomdp_file():
    parsed = read_pomdpx(text())
    again = read_pomdp(write_pomdp(parsed))
    np.testing.assert_array_equal(dense(again.transitions), dense(parsed.transitions))
    np.testing.assert_array_equal(again.expected_rewards(), parsed.expected_rewards())


def test_decision_diagrams_mean_the_same_as_tables():
    x_moves = """<Node var="a"><Edge val="a0"><SubDAG type="persistent" var="x1"/></Edge>
    <Edge val="a1"><Node var="x0"><Edge val="r"><SubDAG type="deterministic" var="x1" val="r"/></Edge>
    <Edge val="l"><Node var="x1"><Edge val="l"><Terminal>0.25</Terminal></Edge>
    <Edge val="r"><Terminal>0.75</Terminal></Edge></Node></Edge></Node></Edge></Node>"""
    seeing = """<Parameter type="DD"><DAG><Node var="y1">
    <Edge val="s0"><SubDAG type="uniform" var="o"/></Edge>
    <Edge val="s1"><SubDAG type="template" idref="even"/></Edge><Edge val="s2"><Node var="a">
    <Edge val="a0"><SubDAG type="deterministic" var="o" val="yes"/></Edge>
    <Edge val="a1"><SubDAG type="template" idref="even"/></Edge></Node></Edge></Node></DAG>
    <SubDAGTemplate id="even"><SubDAG type="uniform" var="o"/></SubDAGTemplate></Parameter>"""
    drawn = conditional("x1", "a x0", diagram(x_moves)), conditional("o", "a y1", seeing)
    parsed, by_tables = read_pomdpx(text(x_moves=drawn[0], seeing=drawn[1])), read_pomdpx(text())
    np.testing.assert_array_equal(dense(parsed.transitions), dense(by_tables.transitions))
    np.testing.assert_array_equal(dense(parsed.observation_probs), dense(by_tables.observation_probs))


MOVES = "<StateTransitionFunction>"


@pytest.mark.parametrize(
    ("change", "seen_at", "message"),
    [
        ({"discount": "2"}, "<Discount>", r"must lie in \[0, 1\], got '2'"),
        ({"x_moves": conditional("x1", "a x9", X_MOVES)}, "a x9", "of the variables .* got 'x9'"),
        ({"x_moves": conditional("x1", "a x0", table(("* l -", "1 0")))}, "* l", r"P\(x1 \| a = a0, x0 ="),
        ({"x_moves": conditional("x1", "a x0", table(("* m -", "1 0")))}, "* m", r"of x0 \(l, r\), got 'm'"),
        ({"x_moves": conditional("x1", "a x0", table(("* -", "1 0")))}, ">* -<", "expected 3 words"),
        ({"x_moves": conditional("x1", "a x0", table(("* l -", "7")))}, ">7<", "2 numbers, got 1 numbers"),
        ({"x_moves": conditional("x1", "a x0", table(("* l -", "1 z")))}, "1 z", "2 numbers, got 'z'"),
        ({"x_moves": conditional("x1", "y1", table(("* -", "1 0")))}, MOVES, "in a circle"),
        ({"x_moves": "<Other/>"}, MOVES, "a <CondProb> for each of"),
        ({"x_moves": conditional("x1", "a", '<Parameter type="LL"/>')}, "LL", "TBL or DD"),
        ({"x_moves": conditional("x1", "a", diagram('<SubDAG type="odd" var="x1"/>'))}, "odd", "got 'odd'"),
        ({"x_moves": conditional("x1", "a", diagram('<Node var="x0"/>'))}, 'Node var="x0"', "got 'x0'"),
        ({"x_moves": "<CondProb>"}, "</StateTransition", "not well-formed XML"),
    ],
)
def test_refusals_name_the_place(change, seen_at, message):
    bad = text(**change)
    with pytest.raises(PomdpError, match=message) as refused:
        read_pomdpx(bad)
    before = bad[: bad.index(seen_at, bad.index(MOVES) if seen_at != "<Discount>" else 0)]
    assert refused.value.line == before.count("\n") + 1


def test_entities_are_refused():
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa">]>\n<pomdpx>&a;</pomdpx>'
    with pytest.raises(PomdpError, match="entities are not allowed"):
        read_pomdpx(bomb)


def test_another_document_is_refused():
    with pytest.raises(PomdpError, match="expected <pomdpx>"):
        read_pomdpx("<html>\n</html>")
