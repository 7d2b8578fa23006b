"""The networks and losses of this package by their kinds."""

from models.grupp2020 import Grupp2020Settings
from models.losses import MultiTaskLoss
from models.unet import UNetSettings

NETWORKS: dict[str, type] = {"multitask_unet": UNetSettings, "grupp2020": Grupp2020Settings}
LOSSES: dict[str, type] = {"multitask": MultiTaskLoss}
