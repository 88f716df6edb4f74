"""Lets LeRobot be imported beside this project's torch; as a program, runs one of LeRobot: its module and arguments."""

import importlib
import sys
import types

import torch

# The torchvision of PyPI is built for CUDA, so its library of operators does not load beside a torch for the CPU, and
# its import fails. These are the two that the import asks for; nothing here calls them.
if "+cpu" in torch.__version__:
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
# Half a gigabyte that draws with --display_data, which is not given; and the colours of words.
sys.modules["rerun"] = types.ModuleType("rerun")
sys.modules["termcolor"] = colours = types.ModuleType("termcolor")
colours.colored = lambda text, *_, **__: text

if __name__ == "__main__":
    importlib.import_module(sys.argv.pop(1)).main()
