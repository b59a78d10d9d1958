//! A report as one HTML file that needs nothing else: its Markdown as a page, with the figures and the replays inside.

use std::io::Write;
use std::path::Path;

use base64::prelude::{BASE64_STANDARD, Engine};
use flate2::Compression;
use flate2::write::GzEncoder;
use pulldown_cmark::{CowStr, Event, Options, Parser, Tag, TagEnd, html};

use crate::error::{Error, Result};
use crate::watch::{self, escaped};

const STYLE: &str = include_str!("page.css");
const REPLAYS: &str = include_str!("replays.js");

/// A link to a file of this kind becomes a button that plays it.
const RECORDING: &str = ".json.gz";

/// The page of a report. Its figures and recordings are read from `folder`.
///
/// # Errors
/// If one of them cannot be read.
pub(super) fn page(markdown: &str, folder: &Path) -> Result<String> {
    let mut events = Vec::new();
    let mut recordings = String::new();
    let mut parser = Parser::new_ext(markdown, Options::ENABLE_TABLES);
    while let Some(event) = parser.next() {
        match event {
            Event::Start(Tag::Image { dest_url, .. }) => {
                let inside = parser.by_ref().take_while(|event| *event != Event::End(TagEnd::Image));
                let caption: Vec<CowStr> = inside.filter_map(text).collect();
                events.push(Event::InlineHtml(figure(&folder.join(&*dest_url), &caption.concat())?.into()));
            }
            Event::Start(Tag::Link { dest_url, title, .. }) if dest_url.ends_with(RECORDING) => {
                let inside = parser.by_ref().take_while(|event| *event != Event::End(TagEnd::Link));
                let label: Vec<CowStr> = inside.filter_map(text).collect();
                let path = folder.join(&*dest_url);
                let bytes = std::fs::read(&path).map_err(Error::io("read", &path))?;
                let id = dest_url.trim_end_matches(RECORDING);
                recordings += &embedded(id, &bytes);
                let [id, title, label] = [id, &title, &label.concat()].map(escaped);
                let button = format!(
                    "<button type=\"button\" class=\"replay\" value=\"{id}\" title=\"{title}\">{label}</button>"
                );
                events.push(Event::InlineHtml(button.into()));
            }
            // On a narrow screen a table scrolls, not the page.
            Event::Start(Tag::Table(_)) => events.extend([Event::Html("<div class=\"table\">".into()), event]),
            Event::End(TagEnd::Table) => events.extend([event, Event::Html("</div>\n".into())]),
            event => events.push(event),
        }
    }
    let title = escaped(markdown.lines().next().unwrap_or_default().trim_start_matches("# "));
    let mut body = String::new();
    html::push_html(&mut body, events.into_iter());
    if !recordings.is_empty() {
        recordings += &embedded("replay-page", &gzip(&watch::empty_page()));
        recordings += &format!("<script type=\"module\">\n{REPLAYS}</script>\n");
    }
    Ok(format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>{title}</title>\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n{recordings}</body>\n</html>\n"
    ))
}

/// Compressed bytes in the page itself, for its script to find by `id`.
fn embedded(id: &str, gzip: &[u8]) -> String {
    let (id, bytes) = (escaped(id), BASE64_STANDARD.encode(gzip));
    format!("<script type=\"application/gzip;base64\" id=\"{id}\">{bytes}</script>\n")
}

/// Compresses a text; the page's script unpacks it.
pub(super) fn gzip(text: &str) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(text.as_bytes()).and_then(|()| encoder.finish()).expect("memory takes everything")
}

fn text(event: Event) -> Option<CowStr> {
    match event {
        Event::Text(text) | Event::Code(text) => Some(text),
        _ => None,
    }
}

/// A figure in the page itself, with its caption. On a narrow screen it scrolls, so that its text stays legible.
fn figure(path: &Path, caption: &str) -> Result<String> {
    let svg = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
    let caption = escaped(caption);
    Ok(format!(
        "<span class=\"figure\"><span class=\"drawing\" role=\"img\" aria-label=\"{caption}\">{svg}</span>\
         <span class=\"caption\">{caption}.</span></span>"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_needs_nothing_else() {
        let folder = tempfile::tempdir().expect("a folder");
        let svg = "<svg viewBox=\"0 0 8 4\"></svg>";
        std::fs::write(folder.path().join("a.svg"), svg).expect("a writable folder");
        let page =
            page("# A\n\n| b |\n| --- |\n| `c` |\n\n![The \"d\" of `e`](a.svg)\n", folder.path()).expect("a page");
        assert!(page.contains("<h1>A</h1>") && page.contains("<td><code>c</code></td>"));
        assert!(page.contains(&format!("aria-label=\"The &quot;d&quot; of e\">{svg}</span>")), "{page}");
        assert!(
            page.contains("<span class=\"caption\">The &quot;d&quot; of e.</span>")
                && page.contains("<title>A</title>")
        );
        assert!(!page.contains("src=") && !page.contains("href="));
        std::fs::write(folder.path().join("b.json.gz"), "gzip").expect("a writable folder");
        let page = super::page("[\"c\"](b.json.gz \"d\")", folder.path()).expect("a page");
        assert!(page.contains("value=\"b\" title=\"d\">&quot;c&quot;</button>"), "{page}");
        assert!(page.contains("id=\"b\">Z3ppcA==</script>") && page.contains("id=\"replay-page\">H4sI"));
        let problem = super::page("![f](g.svg)", folder.path()).expect_err("there is no such figure");
        assert!(problem.to_string().contains("g.svg"), "{problem}");
    }
}
