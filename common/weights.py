"""Files of the nets: float16 safetensors that say what to build."""
import json

import safetensors.torch
import torch

from common.files import UserError, write_atomic
from common.networks import Estimator, Recurrent

ARGUMENTS = {Recurrent: ("inputs", "outputs", "sizes"), Estimator: ("sizes", "dropout", "likelihood", "scale")}


def save_tensors(path, tensors: dict[str, torch.Tensor], **meta):
    """Writes a safetensors file; meta is anything that JSON holds."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    data = safetensors.torch.save(tensors, {"meta": json.dumps(meta)})  # one key: safetensors shuffles several
    write_atomic(path, lambda temporary: temporary.write_bytes(data))


def load_tensors(path) -> tuple[dict[str, torch.Tensor], dict]:
    """The tensors, on the CPU, and the meta of save_tensors.

    Raises UserError: the file is missing or damaged.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            meta = json.loads((file.metadata() or {}).get("meta", "{}"))
            return {name: file.get_tensor(name) for name in file.keys()}, meta
    except (safetensors.SafetensorError, OSError, ValueError):
        raise UserError(f"{path} is missing or damaged: rerun its stage with --force") from None


def save(path, net):
    """Writes a net's weights as float16, with the arguments that made it."""
    halved = {name: x.half() for name, x in net.state_dict().items()}
    save_tensors(path, halved, **{name: getattr(net, name) for name in ARGUMENTS[type(net)]})


def load(kind, path, device="cpu"):
    """The net of class `kind` from a file, float32, without gradients.

    Raises UserError: the file is missing or damaged, or holds another net.
    """
    tensors, meta = load_tensors(path)
    try:
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn in vain: they shall not shift what is drawn later
            net = kind(**meta)
        net.load_state_dict({name: x.float() for name, x in tensors.items()})
    except (TypeError, RuntimeError):
        raise UserError(f"{path} holds another net than expected: rerun its stage with --force, "
                        "or take weights of this version") from None
    return net.to(device).requires_grad_(False)
