"""Files of the nets: float16 safetensors that say what to build."""
import torch

from common.files import UserError, load_tensors, save_tensors
from common.networks import Estimator, Recurrent

ARGUMENTS = {Recurrent: ("inputs", "outputs", "sizes"), Estimator: ("sizes", "dropout", "likelihood", "scale")}


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
