"""The command line `femoreg`. Each sub-command is a typed function; see `femoreg_torch.commands.main`."""
