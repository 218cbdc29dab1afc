"""Several physics side by side."""

import copy

import numpy as np
import pytest
import torch

from gpadjust.physics import (
    BlackBoxPhysics,
    FunctionPhysics,
    JoinedPhysics,
    ODEPhysics,
    PhysicsError,
    Unknown,
)
from tests.systems import refused


def total(X):
    return X.sum(-1)


def first_log(X):
    return X[:, 0].log()


def test_names_are_unique_and_what_is_refused(points):
    for parts, names in (
        ([torch.sin, torch.cos], ("sin", "cos")),
        ([torch.sin, lambda X: X, lambda X: X], ("sin", "f_2", "f_3")),
        ([torch.sin, torch.cos, torch.sin], ("f_1", "cos", "f_3")),
        ([FunctionPhysics(torch.sin, name="f_2"), lambda X: X], ("f_1", "f_2")),
        ({"low": torch.sin, "high": torch.sin}, ("low", "high")),
    ):
        assert JoinedPhysics(parts).names == names
    for parts, says in (
        (torch.sin, "takes a list of physics.*found a builtin_function"),
        ([torch.sin, 3.0], "found a float"),
        ({1: torch.sin}, r"must be text; found \[1\]"),
        ([], "no physics to join"),
        ({}, "no physics to join"),
    ):
        refused(TypeError if parts else ValueError, says, JoinedPhysics, parts)
    pair = JoinedPhysics([torch.sin, total], name="pair")
    refused(PhysicsError, r"'pair'.*2 of 'sin', 1 of 'total'", pair, points(3, 2))


class TestValues:
    def test_columns_and_gradients(self, points):
        X = points(2, 4, 3)
        joined = JoinedPhysics([torch.sin, FunctionPhysics(lambda X: X, inputs=[2, 1, 0])])
        assert torch.equal(joined(X), torch.cat([X.sin(), X.flip(-1)], -1))
        assert joined.num_outputs == 6
        joined = JoinedPhysics(
            [
                torch.sin,
                BlackBoxPhysics(lambda X: np.cos(X[:, ::-1])),
                ODEPhysics(lambda s, a: -s, 0.5, 2),
            ]
        )
        assert torch.autograd.gradcheck(joined, points(2, 3, 2).requires_grad_())

    def test_each_part_has_its_own_memo(self, counter, numpy_counter, points):
        joined = JoinedPhysics(
            [FunctionPhysics(counter), BlackBoxPhysics(numpy_counter, inputs=[0, 1])]
        )
        X = points(5, 3)
        joined(X.expand(4, 5, 3))
        assert len(counter.rows) == len(numpy_counter.rows) == 5
        joined(X)
        assert (len(counter.rows), len(numpy_counter.rows)) == (10, 5)
        joined.forget()
        joined(X)
        assert len(numpy_counter.rows) == 10


class TestErrors:
    def test_names_and_partial_results(self):
        joined = JoinedPhysics({"low": total, "high": FunctionPhysics(first_log)})
        assert [part.name for part in joined.parts] == ["low", "first_log"]
        refused(PhysicsError, "'low' was given no rows", joined, torch.zeros(0, 2))
        with pytest.raises(PhysicsError, match="'first_log'") as caught:
            joined(torch.zeros(1, 1))
        assert caught.value.__notes__ == ["This physics is 'high' of ('low', 'high')."]
        joined(torch.ones(1, 2))
        assert joined(torch.zeros(0, 2)).shape == (0, 2)

        def root(x):
            if x[0] < 0:
                raise ArithmeticError("below zero")
            return np.sqrt(x[0])

        for memo in (0, 10):
            joined = JoinedPhysics([total, BlackBoxPhysics(root, batched=False, memo=memo)])
            with pytest.raises(PhysicsError, match="'root' raised ArithmeticError") as caught:
                joined(torch.tensor([[1.0], [-1.0]]))
            assert caught.value.rows == (1,)
            assert joined(torch.tensor([[4.0]])).tolist() == [[4.0, 2.0]]

    @pytest.mark.parametrize("grad", [False, True])
    def test_of_a_part_names_it_and_the_rows_of_X(self, grad):
        joined = JoinedPhysics([total, FunctionPhysics(first_log, inputs=[1])])
        X = torch.tensor([[1.0, 1.0], [5.0, -1.0]], requires_grad=grad)
        with pytest.raises(PhysicsError, match=r"'first_log'.*NaN") as caught:
            joined(X.unsqueeze(0).expand(2, 2, 2))
        assert caught.value.rows == (1, 3)
        assert caught.value.inputs.tolist() == [[5.0, -1.0]] * 2


def test_deep_copy():
    joined = JoinedPhysics([torch.sin, torch.cos])
    assert copy.deepcopy(joined) is joined
    learnt = JoinedPhysics([torch.sin, torch.nn.Linear(1, 1)])
    duplicate = copy.deepcopy(learnt)
    assert duplicate.parts[0] is learnt.parts[0]
    assert duplicate.parts[1].function is not learnt.parts[1].function


MASS, DRAG = Unknown(1.0, factor=1.5), Unknown(0.1, bounds=(0.0, 1.0))


def push(X, p):
    return X[:, 0] / p.mass


def fall(X, p):
    return (p.mass * X[:, 0] - p.drag).sqrt()


class TestUnknownParameters:
    @staticmethod
    def parts():
        """Their own columns and parameters, of which the mass is one and the same."""
        first = FunctionPhysics(push, unknowns={"mass": MASS}, inputs=[1])
        unknowns = {"drag": DRAG, "mass": MASS}
        return [first, FunctionPhysics(fall, unknowns=unknowns), total]

    def test_of_the_same_name_are_one(self, points):
        X = points(4, 2).square() + 1
        values = torch.tensor([[1.0, 0.5], [2.0, 0.1], [3.0, 0.9]], dtype=torch.float64)
        joined = JoinedPhysics(self.parts())
        assert {**joined.unknowns} == {"mass": MASS, "drag": DRAG}
        mass, drag = values.unsqueeze(-2).unbind(-1)
        x, y = X.unbind(-1)
        expected = torch.stack([y / mass, (mass * x - drag).sqrt(), (x + y).expand(3, 4)], -1)
        nested = JoinedPhysics([JoinedPhysics(self.parts()), lambda X: X[:, [0, 0, 0]]])
        for found in (joined(X, values), joined.or_nan(X, values), nested(X, values)[..., :3]):
            torch.testing.assert_close(found, expected)

    def test_that_contradict_each_other_or_at_which_a_part_fails(self):
        parts = self.parts()
        parts[2] = FunctionPhysics(push, unknowns={"mass": Unknown(1.0, sd=0.1)})
        message = "parameter 'mass', which is then one.*factor=1.5.*sd=0.1.*or different names"
        refused(ValueError, message, JoinedPhysics, parts)
        X = torch.tensor([[1.0, 3.0], [2.0, 4.0]], dtype=torch.float64)
        values = torch.tensor([[1.0, 0.5], [1.0, 1.5], [1.0, 9.0]], dtype=torch.float64)
        joined = JoinedPhysics(self.parts())
        found = joined.or_nan(X, values)
        assert found.isnan().all(-1).tolist() == [[False, False], [True, False], [True, True]]
        assert found.isnan().any(-1).tolist() == found.isnan().all(-1).tolist()
        with pytest.raises(PhysicsError, match="'fall' returned NaN") as caught:
            joined(X, values)
        assert caught.value.rows == (2, 4, 5)
        assert caught.value.inputs[0].tolist() == [1.0, 3.0, 1.0, 1.5]
