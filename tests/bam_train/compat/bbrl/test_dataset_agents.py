import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

from bam_train.compat.bbrl.dataset_agents import DataLoaderAgent, ShuffledDatasetAgent
from bam_train.errors import LoopError
from bam_train.loop import Workspace

DATA = TensorDataset(torch.arange(10.0).reshape(5, 2), torch.arange(5))


def run(agent):
    workspace = Workspace()
    agent(workspace)
    return workspace


def drawn(agent, calls=3):
    return [run(agent)["y"][0].tolist() for _ in range(calls)]


def test_a_data_loader_from_begin_to_end():
    agent = DataLoaderAgent(DataLoader(DATA, batch_size=2))
    seen = []
    workspace = run(agent)
    while not agent.finished():
        seen.append(workspace["y"][0].tolist())
        assert workspace["x"][0, :, 1].tolist() == [2 * y + 1 for y in seen[-1]]
        workspace = run(agent)
    assert seen == [[0, 1], [2, 3], [4]]
    assert list(workspace.keys()) == []
    assert list(run(agent).keys()) == []
    agent.reset()
    assert not agent.finished()
    assert run(agent)["y"][0].tolist() == [0, 1]


def test_names_and_device():
    agent = DataLoaderAgent(DataLoader(DATA, batch_size=5), output_names=("points",)).to("meta")
    workspace = run(agent)
    assert list(workspace.keys()) == ["points"]
    assert workspace["points"].device.type == "meta"
    assert agent.writes == ("points",)


@pytest.mark.parametrize("batch", [{"y": torch.ones(2), "x": torch.zeros(2)}, (torch.zeros(2), torch.ones(2))])
def test_batches_are_mappings_or_tuples(batch):
    workspace = run(DataLoaderAgent([batch]))
    assert [workspace["x"].tolist(), workspace["y"].tolist()] == [[[0, 0]], [[1, 1]]]


def test_a_batch_is_one_tensor():
    assert run(DataLoaderAgent([torch.ones(2, 3)], ("x",)))["x"].shape == (1, 2, 3)


@pytest.mark.parametrize(
    ("batch", "message"),
    [
        ([torch.zeros(2)], "output_names: expected as many as the dataset has values (1), found ('x', 'y')."),
        ({"x": torch.zeros(2)}, "The dataset has no 'y'; its items have 'x'."),
    ],
)
def test_too_few_values(batch, message):
    with pytest.raises(LoopError) as caught:
        run(DataLoaderAgent([batch]))
    assert str(caught.value) == message


def test_a_shuffled_dataset_writes_items():
    workspace = run(ShuffledDatasetAgent(DATA, 20).seed(1))
    assert workspace["x"].shape == (1, 20, 2)
    assert workspace["x"][0, :, 0].tolist() == [2 * y for y in workspace["y"][0].tolist()]
    assert set(workspace["y"][0].tolist()) == {0, 1, 2, 3, 4}


def test_a_seed_makes_it_reproducible():
    first = drawn(ShuffledDatasetAgent(DATA, 8).seed(1))
    assert drawn(ShuffledDatasetAgent(DATA, 8).seed(1)) == first
    assert drawn(ShuffledDatasetAgent(DATA, 8).seed(2)) != first
    assert drawn(ShuffledDatasetAgent(DATA, 8).seed()) != first


def test_unseeded_it_draws_from_torchs_global_generator():
    agent = ShuffledDatasetAgent(DATA, 8)
    torch.manual_seed(5)
    first = drawn(agent)
    torch.manual_seed(5)
    assert drawn(agent) == first


def test_an_empty_dataset():
    with pytest.raises(LoopError, match=r"^The dataset is empty: there is nothing to draw from"):
        run(ShuffledDatasetAgent([], 2))


@pytest.mark.parametrize("seed", [-1, "a", 1.5])
def test_seeds_are_natural_numbers(seed):
    with pytest.raises(LoopError, match=r"^seed: expected a whole number of at least 0.*, found"):
        ShuffledDatasetAgent(DATA, 2).seed(seed)
