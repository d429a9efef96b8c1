"""The networks of picofarm in PyTorch: the same numbers, and how long they take.

usage: model_torch.py parity FILE...
       model_torch.py bench [--channels-last] [--device cuda [--tf32]] FILE

FILE comes from `just lab model --record FILE`: weights, a batch, and what picofarm made of them. `parity` computes
the same and fails where outputs differ by more than 1e-4, a gradient by more than 1e-3 of its norm, or the losses of the
steps of AdamW by more than 1e-3 (NLOST: 1e-2); in bfloat16 (`--precision bf16`, autocast here), where the gradient as a whole differs by
more than rounding moves PyTorch's own. `bench` takes steps when told to: it reads numbers of steps line by line and answers with
seconds (`just lab model --peer` does that between its own); on an NVIDIA card with `--device cuda`, in 32 bits there unless
`--tf32` lets products be rounded to 19 bits. Needs picofarm[torch], whose networks it runs.
"""

import argparse
import json
import sys
import time

import picofarm.torch
import torch
from safetensors import safe_open
from torch.nn import functional as F


class Trial:
    def __init__(self, path, device="cpu"):
        self.device = device
        with safe_open(path, "pt", device) as file:
            self.spec = json.loads(file.metadata()["trial"])
            self.tensors = {name: file.get_tensor(name) for name in file.keys()}
        net = self.spec["net"]
        self.bf16 = net.get("precision") == "bf16"
        self.model = picofarm.torch.network(net).to(device)
        self.reset()
        self.dense, self.target = self.tensors["input/dense"], self.tensors["target"]
        self.one_hot = None
        if net["one_hot"]:
            bins = self.tensors["input/one_hot"].long()
            self.one_hot = (bins[:, None] == torch.arange(net["one_hot"], device=device)[:, None, None]).float()

    def part(self, name):
        return {k[len(name) + 1 :]: v for k, v in self.tensors.items() if k.startswith(name + "/")}

    def reset(self):
        state = self.part("weights")
        for name in state:
            if name.endswith("num_batches_tracked"):
                state[name] = state[name].reshape(()).long()
        self.model.load_state_dict(state)
        self.model.train()
        learned = [p for p in self.model.parameters() if p.requires_grad]
        self.optimiser = torch.optim.AdamW(learned, lr=self.spec["learning_rate"], weight_decay=self.spec["decay"])

    def ask(self):
        with torch.autocast(self.device, dtype=torch.bfloat16, enabled=self.bf16):
            return self.model(self.dense, self.one_hot).float()

    def loss(self):
        output = self.ask()
        if self.spec["target"] == "tof":
            return output, F.l1_loss(output, self.target)
        return output, F.binary_cross_entropy_with_logits(output, self.target)

    def step(self):
        self.optimiser.zero_grad()
        _, loss = self.loss()
        loss.backward()
        self.optimiser.step()
        return loss.item()


def rounding(trial):
    """How far the gradient in bfloat16 lies from that in 32 bits, of its norm."""
    gradients = []
    for bf16 in (False, True):
        trial.bf16 = bf16
        trial.reset()
        trial.optimiser.zero_grad()
        trial.loss()[1].backward()
        gradients.append(torch.cat([p.grad.flatten() for p in trial.model.parameters() if p.grad is not None]))
    return ((gradients[1] - gradients[0]).norm() / gradients[0].norm()).item()


def parity(path):
    trial = Trial(path)
    trial.model.eval()
    with torch.no_grad():
        evaluated = trial.ask()
    trial.model.train()
    output, loss = trial.loss()
    loss.backward()
    worst, off_all, all_of = ("", 0.0), 0.0, 0.0
    gradients = trial.part("gradient")
    for name, parameter in trial.model.named_parameters():
        if parameter.grad is None:
            assert name not in gradients, f"{name} has no gradient here"
            continue
        theirs, ours = parameter.grad, gradients.pop(name)
        off = ((theirs - ours).norm() / theirs.norm().clamp_min(1e-12)).item()
        off_all += (theirs - ours).square().sum().item()
        all_of += theirs.square().sum().item()
        worst = max(worst, (name, off), key=lambda pair: pair[1])
    state = {k: v.clone() for k, v in trial.model.state_dict().items()}
    assert not gradients, f"gradients of {sorted(gradients)} are unknown here"
    trial.reset()
    if trial.bf16:
        # Rounding alone moves single gradients that nearly cancel by their own size.
        worst = ("all together", (off_all / all_of) ** 0.5)
    ours = trial.tensors["losses"]
    losses = torch.tensor([trial.step() for _ in ours])
    figures = {
        "output": (output - trial.tensors["output"]).abs().max().item(),
        "evaluated": (evaluated - trial.tensors["evaluated"]).abs().max().item(),
        "gradient": worst[1],
        "losses": (losses - ours).abs().max().item(),
        "statistics": max(((state[k] - v).abs().max().item() for k, v in trial.part("after").items()), default=0.0),
    }
    limits = {"output": 1e-4, "evaluated": 1e-4, "gradient": 1e-3, "losses": 1e-3, "statistics": 1e-4}
    if trial.spec["net"]["architecture"] == "nlost":
        # The moment of a greatest value jumps where two are nearly equal, and a pixel's depth with it.
        limits["losses"] = 1e-2
    if trial.bf16:
        # As far as rounding moves PyTorch itself.
        limits |= {"output": 1e-1, "evaluated": 1e-2, "gradient": rounding(trial), "losses": 1e-2, "statistics": 1e-3}
    parameters = sum(p.numel() for p in trial.model.parameters())
    print(f"{path}: {trial.spec['target']}, {trial.spec['net']['architecture']}, {parameters} parameters, torch {torch.__version__}")
    for name, value in figures.items():
        verdict = "ok" if value <= limits[name] else "TOO FAR OFF"
        more = f" ({worst[0]})" if name == "gradient" else ""
        print(f"  {name:10} {value:.2e} of {limits[name]:.0e} allowed  {verdict}{more}")
    print(f"  loss {losses[0]:.6f} to {losses[-1]:.6f} in {len(losses)} steps, ours {ours[0]:.6f} to {ours[-1]:.6f}")
    return all(value <= limits[name] for name, value in figures.items())


def with_channels_last(tensor):
    """The tensor with its channels last in memory: of images and of volumes; others as they are."""
    form = {4: torch.channels_last, 5: torch.channels_last_3d}.get(tensor.dim())
    return tensor if form is None else tensor.contiguous(memory_format=form)


def bench(path, channels_last, device, tf32):
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = tf32
    torch.backends.cudnn.benchmark = True
    trial = Trial(path, device)
    if channels_last:
        for held in [*trial.model.parameters(), *trial.model.buffers()]:
            held.data = with_channels_last(held.data)
        trial.dense = with_channels_last(trial.dense)
        trial.reset()
    # A step brings its batch to the card, as picofarm's does; from pinned memory, as a loader gives it.
    host = trial.dense.cpu().pin_memory() if device == "cuda" else None
    more = (", " + device if device != "cpu" else "") + (", TF32" if tf32 else "") + (", channels last" if channels_last else "")
    name = f"PyTorch {torch.__version__}{more}"
    print(json.dumps({"tool": name, "threads": torch.get_num_threads()}), flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        for _ in range(int(line)):
            if host is not None:
                trial.dense = host.to(device, non_blocking=True)
            trial.step()
        print(time.perf_counter() - begun, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, dest="command")
    commands.add_parser("parity").add_argument("files", nargs="+")
    timed = commands.add_parser("bench")
    timed.add_argument("--channels-last", action="store_true")
    timed.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    timed.add_argument("--tf32", action="store_true")
    timed.add_argument("file")
    asked = parser.parse_args()
    if asked.command == "parity":
        sys.exit(0 if all([parity(path) for path in asked.files]) else 1)
    bench(asked.file, asked.channels_last, asked.device, asked.tf32)
