//! A report as one HTML file that needs nothing else: its Markdown as a page, with the figures inside.

use std::path::Path;

use pulldown_cmark::{CowStr, Event, Options, Parser, Tag, TagEnd, html};

use crate::error::{Error, Result};

const STYLE: &str = include_str!("page.css");

/// The page of a report. Its figures are read from `folder`.
///
/// # Errors
/// If a figure cannot be read.
pub(super) fn page(markdown: &str, folder: &Path) -> Result<String> {
    let mut events = Vec::new();
    let mut parser = Parser::new_ext(markdown, Options::ENABLE_TABLES);
    while let Some(event) = parser.next() {
        match event {
            Event::Start(Tag::Image { dest_url, .. }) => {
                let inside = parser.by_ref().take_while(|event| *event != Event::End(TagEnd::Image));
                let caption: Vec<CowStr> = inside.filter_map(text).collect();
                events.push(Event::InlineHtml(figure(&folder.join(&*dest_url), &caption.concat())?.into()));
            }
            // On a narrow screen a table scrolls, not the page.
            Event::Start(Tag::Table(_)) => events.extend([Event::Html("<div class=\"table\">".into()), event]),
            Event::End(TagEnd::Table) => events.extend([event, Event::Html("</div>\n".into())]),
            event => events.push(event),
        }
    }
    let mut body = String::new();
    html::push_html(&mut body, events.into_iter());
    Ok(format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<title>Comparison</title>\n<meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\">\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n"
    ))
}

fn text(event: Event) -> Option<CowStr> {
    match event {
        Event::Text(text) | Event::Code(text) => Some(text),
        _ => None,
    }
}

/// A figure in the page itself, with what it shows for those who do not see it.
fn figure(path: &Path, caption: &str) -> Result<String> {
    let svg = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
    let label = caption.replace('&', "&amp;").replace('"', "&quot;");
    Ok(format!("<span class=\"figure\" role=\"img\" aria-label=\"{label}\">{svg}</span>"))
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
        assert!(!page.contains("src=") && !page.contains("href="));
        let problem = super::page("![f](g.svg)", folder.path()).expect_err("there is no such figure");
        assert!(problem.to_string().contains("g.svg"), "{problem}");
    }
}
