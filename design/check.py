"""python -m design.check: prove a stored coupling again (design.certificate.verify); the command is cli/check.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("check")
