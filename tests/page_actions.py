"""Actions on the web page of the service that several test files use."""

from playwright.sync_api import Page

FIELDS = {"color": "image/png", "depth": "image/png", "labels": "image/png", "intrinsics": "application/json"}


def upload(page: Page, files: dict[str, bytes], color_name: str = "color.png") -> None:
    """Upload a frame, which may lack labels, and have it recognized."""
    if not page.locator("#upload-form").is_visible():
        page.get_by_text("Upload your own frame").click()
    for field, content in files.items():
        name = color_name if field == "color" else field
        page.locator(f"#{field}").set_input_files({"name": name, "mimeType": FIELDS[field], "buffer": content})
    page.get_by_role("button", name="Recognize", exact=True).click()
