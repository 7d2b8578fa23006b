"""`python -m femoreg_torch` is the command `femoreg`."""

from femoreg_torch.commands.main import console_script

if __name__ == "__main__":
    console_script()
