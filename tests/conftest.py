"""Every test on one torch thread: results of larger layers depend on the number."""

import torch

torch.set_num_threads(1)
