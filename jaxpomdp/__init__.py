"""Learning to act in worlds that cannot be fully seen: action-conditioned HMMs with utility, in JAX.

The public names below load their module when they are first used, so importing the package costs nothing but
itself, and runs where Gymnasium, matplotlib and the command line's libraries are not installed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxpomdp._types import Chain as Chain
    from jaxpomdp._types import Posterior as Posterior
    from jaxpomdp._types import TrialBatch as TrialBatch
    from jaxpomdp.agents.agent import Agent as Agent
    from jaxpomdp.agents.agent import AgentConfig as AgentConfig
    from jaxpomdp.agents.agent import AgentState as AgentState
    from jaxpomdp.agents.agent import make_agent as make_agent
    from jaxpomdp.agents.control import ControlConfig as ControlConfig
    from jaxpomdp.agents.control import Schedule as Schedule
    from jaxpomdp.agents.coupled_kind import CoupledModel as CoupledModel
    from jaxpomdp.agents.coupled_tree_kind import CoupledTreeModel as CoupledTreeModel
    from jaxpomdp.agents.gym_agent import GymAgent as GymAgent
    from jaxpomdp.agents.kinds import FlatModel as FlatModel
    from jaxpomdp.agents.kinds import Kind as Kind
    from jaxpomdp.agents.learner import LearnerConfig as LearnerConfig
    from jaxpomdp.agents.planners import PlannerConfig as PlannerConfig
    from jaxpomdp.agents.planners import plan as plan
    from jaxpomdp.agents.policies import Policy as Policy
    from jaxpomdp.agents.policies import evaluate_policy as evaluate_policy
    from jaxpomdp.agents.tree_evidence import gather_tree_evidence as gather_tree_evidence
    from jaxpomdp.coupled_packing import pack_coupled as pack_coupled
    from jaxpomdp.coupled_packing import pack_coupled_trees as pack_coupled_trees
    from jaxpomdp.coupled_packing import unpack_coupled as unpack_coupled
    from jaxpomdp.coupled_packing import unpack_coupled_trees as unpack_coupled_trees
    from jaxpomdp.envs.drawing import draw as draw
    from jaxpomdp.envs.hallway import hallway as hallway
    from jaxpomdp.envs.hallway import hallway_navigation as hallway_navigation
    from jaxpomdp.envs.maze89 import heading_maze as heading_maze
    from jaxpomdp.envs.maze89 import maze57 as maze57
    from jaxpomdp.envs.maze89 import maze89 as maze89
    from jaxpomdp.envs.maze89 import tiger_grid as tiger_grid
    from jaxpomdp.envs.pomdp_file import read_pomdp as read_pomdp
    from jaxpomdp.envs.pomdp_tables import ParsedPOMDP as ParsedPOMDP
    from jaxpomdp.envs.pomdp_world import from_pomdp as from_pomdp
    from jaxpomdp.envs.pomdp_world import to_pomdp as to_pomdp
    from jaxpomdp.envs.pomdp_write import write_pomdp as write_pomdp
    from jaxpomdp.envs.pomdpx import read_pomdpx as read_pomdpx
    from jaxpomdp.envs.registry import make as make
    from jaxpomdp.envs.tmaze import tmaze as tmaze
    from jaxpomdp.envs.world import Step as Step
    from jaxpomdp.envs.world import TrueModel as TrueModel
    from jaxpomdp.envs.world import World as World
    from jaxpomdp.envs.world import model_of as model_of
    from jaxpomdp.envs.world import reset as reset
    from jaxpomdp.envs.world import reset_key as reset_key
    from jaxpomdp.envs.world import step as step
    from jaxpomdp.envs.world import step_key as step_key
    from jaxpomdp.envs.wrappers import limited as limited
    from jaxpomdp.envs.wrappers import noisy as noisy
    from jaxpomdp.experiments.config import RunConfig as RunConfig
    from jaxpomdp.experiments.results import RunData as RunData
    from jaxpomdp.experiments.results import load_run as load_run
    from jaxpomdp.experiments.runner import run as run
    from jaxpomdp.experiments.tree_animation import growth_animation as growth_animation
    from jaxpomdp.experiments.tree_animation import tree_belief_animation as tree_belief_animation
    from jaxpomdp.experiments.tree_drawing import tree_picture as tree_picture
    from jaxpomdp.kernels.decoding import Decoded as Decoded
    from jaxpomdp.kernels.decoding import viterbi as viterbi
    from jaxpomdp.kernels.filtering import Filtered as Filtered
    from jaxpomdp.kernels.filtering import filter_tape as filter_tape
    from jaxpomdp.kernels.filtering import observe as observe
    from jaxpomdp.kernels.filtering import predict as predict
    from jaxpomdp.kernels.filtering import predict_observation as predict_observation
    from jaxpomdp.kernels.filtering import predict_steps as predict_steps
    from jaxpomdp.kernels.filtering import update_belief as update_belief
    from jaxpomdp.kernels.planning import perseus as perseus
    from jaxpomdp.kernels.planning import value_iteration as value_iteration
    from jaxpomdp.kernels.posterior import posterior as posterior
    from jaxpomdp.kernels.sampling import sample_path as sample_path
    from jaxpomdp.kernels.sampling import sample_posterior as sample_posterior
    from jaxpomdp.kernels.smoothing import smooth as smooth
    from jaxpomdp.models.coupled import COUPLED_MIXTURE as COUPLED_MIXTURE
    from jaxpomdp.models.coupled import COUPLED_PRODUCT as COUPLED_PRODUCT
    from jaxpomdp.models.coupled import CoupledParams as CoupledParams
    from jaxpomdp.models.coupled_init import couple as couple
    from jaxpomdp.models.coupled_init import silent as silent
    from jaxpomdp.models.coupled_tree import COUPLED_TREE as COUPLED_TREE
    from jaxpomdp.models.coupled_tree import CoupledTreeParams as CoupledTreeParams
    from jaxpomdp.models.data import trial_batch as trial_batch
    from jaxpomdp.models.em import EMConfig as EMConfig
    from jaxpomdp.models.em import EMReport as EMReport
    from jaxpomdp.models.em import e_step as e_step
    from jaxpomdp.models.em import em_step as em_step
    from jaxpomdp.models.em import fit as fit
    from jaxpomdp.models.emission import Categorical as Categorical
    from jaxpomdp.models.emission import DiagonalGaussian as DiagonalGaussian
    from jaxpomdp.models.emission import ReturnModel as ReturnModel
    from jaxpomdp.models.family import Family as Family
    from jaxpomdp.models.family import Prior as Prior
    from jaxpomdp.models.flat import FLAT as FLAT
    from jaxpomdp.models.flat import FlatParams as FlatParams
    from jaxpomdp.models.full_gaussian import FullGaussian as FullGaussian
    from jaxpomdp.models.gradient import GradientConfig as GradientConfig
    from jaxpomdp.models.gradient import fit_gradient as fit_gradient
    from jaxpomdp.models.hierarchical import HIERARCHICAL as HIERARCHICAL
    from jaxpomdp.models.hierarchical import TreeParams as TreeParams
    from jaxpomdp.models.hierarchical import beliefs_of_nodes as beliefs_of_nodes
    from jaxpomdp.models.hierarchical import path_of_nodes as path_of_nodes
    from jaxpomdp.models.init import Real as Real
    from jaxpomdp.models.init import observation_seeded as observation_seeded
    from jaxpomdp.models.init import random_params as random_params
    from jaxpomdp.models.selection import bic as bic
    from jaxpomdp.models.selection import fit_restarts as fit_restarts
    from jaxpomdp.models.selection import held_out as held_out
    from jaxpomdp.models.selection import log_evidence as log_evidence
    from jaxpomdp.models.store import load as load
    from jaxpomdp.models.store import save as save
    from jaxpomdp.packing import TreeCapacity as TreeCapacity
    from jaxpomdp.packing import pack as pack
    from jaxpomdp.packing import unpack as unpack
    from jaxpomdp.structure.coupled_spec import CoupledSpec as CoupledSpec
    from jaxpomdp.structure.coupled_tree import CoupledTreeSpec as CoupledTreeSpec
    from jaxpomdp.structure.coupled_tree import coupled_tree as coupled_tree
    from jaxpomdp.structure.coupled_tree_edits import COUPLED_TREE_OPERATORS as COUPLED_TREE_OPERATORS
    from jaxpomdp.structure.coupled_tree_edits import CousinSplitConfig as CousinSplitConfig
    from jaxpomdp.structure.evidence import ReturnEvidence as ReturnEvidence
    from jaxpomdp.structure.evidence import return_evidence as return_evidence
    from jaxpomdp.structure.operators import TREE_SPLITS as TREE_SPLITS
    from jaxpomdp.structure.policy import PolicyConfig as PolicyConfig
    from jaxpomdp.structure.policy import revise as revise
    from jaxpomdp.structure.spec import FlatSpec as FlatSpec
    from jaxpomdp.structure.splits import SplitConfig as SplitConfig
    from jaxpomdp.structure.tree import TreeSpec as TreeSpec
    from jaxpomdp.structure.tree_evidence import TreeEvidence as TreeEvidence
    from jaxpomdp.structure.tree_forms import flatten_tree as flatten_tree
    from jaxpomdp.structure.tree_forms import maximal as maximal
    from jaxpomdp.structure.tree_forms import minimal as minimal
    from jaxpomdp.structure.tree_forms import one_level as one_level
    from jaxpomdp.structure.tree_init import random_tree as random_tree
    from jaxpomdp.structure.tree_init import tree_over as tree_over
    from jaxpomdp.structure.tree_tests import TreeSplitConfig as TreeSplitConfig

__version__ = "0.1.0"

_HOMES = {
    "Agent": "jaxpomdp.agents.agent",
    "AgentConfig": "jaxpomdp.agents.agent",
    "AgentState": "jaxpomdp.agents.agent",
    "COUPLED_MIXTURE": "jaxpomdp.models.coupled",
    "COUPLED_PRODUCT": "jaxpomdp.models.coupled",
    "COUPLED_TREE": "jaxpomdp.models.coupled_tree",
    "COUPLED_TREE_OPERATORS": "jaxpomdp.structure.coupled_tree_edits",
    "Categorical": "jaxpomdp.models.emission",
    "Chain": "jaxpomdp._types",
    "ControlConfig": "jaxpomdp.agents.control",
    "CoupledModel": "jaxpomdp.agents.coupled_kind",
    "CoupledParams": "jaxpomdp.models.coupled",
    "CoupledSpec": "jaxpomdp.structure.coupled_spec",
    "CoupledTreeModel": "jaxpomdp.agents.coupled_tree_kind",
    "CoupledTreeParams": "jaxpomdp.models.coupled_tree",
    "CoupledTreeSpec": "jaxpomdp.structure.coupled_tree",
    "CousinSplitConfig": "jaxpomdp.structure.coupled_tree_edits",
    "Decoded": "jaxpomdp.kernels.decoding",
    "DiagonalGaussian": "jaxpomdp.models.emission",
    "EMConfig": "jaxpomdp.models.em",
    "EMReport": "jaxpomdp.models.em",
    "FLAT": "jaxpomdp.models.flat",
    "Family": "jaxpomdp.models.family",
    "Filtered": "jaxpomdp.kernels.filtering",
    "FlatModel": "jaxpomdp.agents.kinds",
    "FlatParams": "jaxpomdp.models.flat",
    "FlatSpec": "jaxpomdp.structure.spec",
    "FullGaussian": "jaxpomdp.models.full_gaussian",
    "GradientConfig": "jaxpomdp.models.gradient",
    "GymAgent": "jaxpomdp.agents.gym_agent",
    "HIERARCHICAL": "jaxpomdp.models.hierarchical",
    "Kind": "jaxpomdp.agents.kinds",
    "LearnerConfig": "jaxpomdp.agents.learner",
    "ParsedPOMDP": "jaxpomdp.envs.pomdp_tables",
    "PlannerConfig": "jaxpomdp.agents.planners",
    "Policy": "jaxpomdp.agents.policies",
    "PolicyConfig": "jaxpomdp.structure.policy",
    "Posterior": "jaxpomdp._types",
    "Prior": "jaxpomdp.models.family",
    "Real": "jaxpomdp.models.init",
    "ReturnEvidence": "jaxpomdp.structure.evidence",
    "ReturnModel": "jaxpomdp.models.emission",
    "RunConfig": "jaxpomdp.experiments.config",
    "RunData": "jaxpomdp.experiments.results",
    "Schedule": "jaxpomdp.agents.control",
    "SplitConfig": "jaxpomdp.structure.splits",
    "Step": "jaxpomdp.envs.world",
    "TREE_SPLITS": "jaxpomdp.structure.operators",
    "TreeCapacity": "jaxpomdp.packing",
    "TreeEvidence": "jaxpomdp.structure.tree_evidence",
    "TreeParams": "jaxpomdp.models.hierarchical",
    "TreeSpec": "jaxpomdp.structure.tree",
    "TreeSplitConfig": "jaxpomdp.structure.tree_tests",
    "TrialBatch": "jaxpomdp._types",
    "TrueModel": "jaxpomdp.envs.world",
    "World": "jaxpomdp.envs.world",
    "beliefs_of_nodes": "jaxpomdp.models.hierarchical",
    "bic": "jaxpomdp.models.selection",
    "couple": "jaxpomdp.models.coupled_init",
    "coupled_tree": "jaxpomdp.structure.coupled_tree",
    "draw": "jaxpomdp.envs.drawing",
    "e_step": "jaxpomdp.models.em",
    "em_step": "jaxpomdp.models.em",
    "evaluate_policy": "jaxpomdp.agents.policies",
    "filter_tape": "jaxpomdp.kernels.filtering",
    "fit": "jaxpomdp.models.em",
    "fit_gradient": "jaxpomdp.models.gradient",
    "fit_restarts": "jaxpomdp.models.selection",
    "flatten_tree": "jaxpomdp.structure.tree_forms",
    "from_pomdp": "jaxpomdp.envs.pomdp_world",
    "gather_tree_evidence": "jaxpomdp.agents.tree_evidence",
    "growth_animation": "jaxpomdp.experiments.tree_animation",
    "hallway": "jaxpomdp.envs.hallway",
    "hallway_navigation": "jaxpomdp.envs.hallway",
    "heading_maze": "jaxpomdp.envs.maze89",
    "held_out": "jaxpomdp.models.selection",
    "limited": "jaxpomdp.envs.wrappers",
    "load": "jaxpomdp.models.store",
    "load_run": "jaxpomdp.experiments.results",
    "log_evidence": "jaxpomdp.models.selection",
    "make": "jaxpomdp.envs.registry",
    "make_agent": "jaxpomdp.agents.agent",
    "maximal": "jaxpomdp.structure.tree_forms",
    "maze57": "jaxpomdp.envs.maze89",
    "maze89": "jaxpomdp.envs.maze89",
    "minimal": "jaxpomdp.structure.tree_forms",
    "model_of": "jaxpomdp.envs.world",
    "noisy": "jaxpomdp.envs.wrappers",
    "observation_seeded": "jaxpomdp.models.init",
    "observe": "jaxpomdp.kernels.filtering",
    "one_level": "jaxpomdp.structure.tree_forms",
    "pack": "jaxpomdp.packing",
    "pack_coupled": "jaxpomdp.coupled_packing",
    "pack_coupled_trees": "jaxpomdp.coupled_packing",
    "path_of_nodes": "jaxpomdp.models.hierarchical",
    "perseus": "jaxpomdp.kernels.planning",
    "plan": "jaxpomdp.agents.planners",
    "posterior": "jaxpomdp.kernels.posterior",
    "predict": "jaxpomdp.kernels.filtering",
    "predict_observation": "jaxpomdp.kernels.filtering",
    "predict_steps": "jaxpomdp.kernels.filtering",
    "random_params": "jaxpomdp.models.init",
    "random_tree": "jaxpomdp.structure.tree_init",
    "read_pomdp": "jaxpomdp.envs.pomdp_file",
    "read_pomdpx": "jaxpomdp.envs.pomdpx",
    "reset": "jaxpomdp.envs.world",
    "reset_key": "jaxpomdp.envs.world",
    "return_evidence": "jaxpomdp.structure.evidence",
    "revise": "jaxpomdp.structure.policy",
    "run": "jaxpomdp.experiments.runner",
    "sample_path": "jaxpomdp.kernels.sampling",
    "sample_posterior": "jaxpomdp.kernels.sampling",
    "save": "jaxpomdp.models.store",
    "silent": "jaxpomdp.models.coupled_init",
    "smooth": "jaxpomdp.kernels.smoothing",
    "step": "jaxpomdp.envs.world",
    "step_key": "jaxpomdp.envs.world",
    "tiger_grid": "jaxpomdp.envs.maze89",
    "tmaze": "jaxpomdp.envs.tmaze",
    "to_pomdp": "jaxpomdp.envs.pomdp_world",
    "tree_belief_animation": "jaxpomdp.experiments.tree_animation",
    "tree_over": "jaxpomdp.structure.tree_init",
    "tree_picture": "jaxpomdp.experiments.tree_drawing",
    "trial_batch": "jaxpomdp.models.data",
    "unpack": "jaxpomdp.packing",
    "unpack_coupled": "jaxpomdp.coupled_packing",
    "unpack_coupled_trees": "jaxpomdp.coupled_packing",
    "update_belief": "jaxpomdp.kernels.filtering",
    "value_iteration": "jaxpomdp.kernels.planning",
    "viterbi": "jaxpomdp.kernels.decoding",
    "write_pomdp": "jaxpomdp.envs.pomdp_write",
}
_ROOMS = ("agents", "cli", "envs", "experiments", "kernels", "models", "numerics", "packing", "structure")

__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Load a public name, or a room of the house, when it is first asked for (PEP 562)."""
    if name in _ROOMS:
        return import_module(f"jaxpomdp.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxpomdp' has no public name {name!r}; there are {', '.join(__all__)}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, *_ROOMS, "__version__"]
