"""Models from and to the Hugging Face Hub; the one place that talks to it."""

from collections.abc import Sequence
from pathlib import Path


def download(repository: str, names: Sequence[str]) -> Path:
    """Those of the named files that a repository has, downloaded and cached; gives their folder.

    A FileNotFoundError: the Hub gave nothing under that id, or cannot be reached and nothing is cached.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        return Path(snapshot_download(repository, allow_patterns=list(names)))
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        raise FileNotFoundError(
            f"no folder {repository} here, and the Hub gave nothing under that id ({type(error).__name__}): "
            "check the path or the id, and the network"
        ) from error


def upload(folder: Path, repository: str, *, private: bool, token: str | None) -> str:
    """Put a folder's files into a repository, which is made where there is none; gives its address.

    A ValueError: that is no name; a PermissionError: the Hub refuses; a ConnectionError: it cannot be
    reached.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalTokenNotFoundError

    hub = HfApi(token=token)
    try:
        made = hub.create_repo(repository, private=private, exist_ok=True)
        hub.upload_folder(repo_id=made.repo_id, folder_path=folder, commit_message="A derender model")
    except HFValidationError as error:
        raise ValueError(f"{repository!r} is no name on the Hub: give OWNER/NAME") from error
    except (HfHubHTTPError, LocalTokenNotFoundError) as error:
        raise PermissionError(
            f"the Hub refuses {repository} ({' '.join(str(error).split())}): log in with 'hf auth login' or "
            "pass token=, with the right to write there"
        ) from error
    except Exception as error:  # what a broken connection raises changes with the client's HTTP library
        raise ConnectionError(
            f"the Hub cannot be reached ({type(error).__name__}: {error}); nothing is lost: "
            "model.save_pretrained writes the same files to a folder"
        ) from error
    return str(made)
