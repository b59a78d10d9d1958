//! Chapters as pages: the output of each cell below it, formulas as MathML, and pictures with paths relative to the page.

use std::path::PathBuf;

use pulldown_latex::config::DisplayMode;
use pulldown_latex::{Parser, RenderConfig, Storage, push_mathml};

use crate::chapter::{Chapter, Part};
use crate::notebook::Answer;

/// A page and the picture files that it needs, relative to the repository.
pub struct Page {
    /// Markdown for mdBook.
    pub content: String,
    /// Pictures.
    pub pictures: Vec<PathBuf>,
}

impl Page {
    /// The page of a chapter whose cells have these outputs.
    ///
    /// # Errors
    /// If a formula cannot be parsed.
    pub fn new(chapter: &Chapter, answers: &[Answer]) -> anyhow::Result<Self> {
        let mut page = Self { content: String::new(), pictures: Vec::new() };
        let mut answers = answers.iter();
        for part in &chapter.parts {
            match part {
                Part::Text(text) => {
                    let text = page.with_pictures(&formulas(text)?);
                    page.content += &text;
                }
                Part::Cell { code, .. } => {
                    page.content += &format!("```rust\n{code}```\n");
                    if let Some(answer) = answers.next() {
                        page.content += &shown(answer);
                    }
                }
            }
            page.content.push('\n');
        }
        Ok(page)
    }

    /// Pages are in another folder than chapters: `../data/...` becomes `data/...`.
    fn with_pictures(&mut self, text: &str) -> String {
        for piece in text.split("](../data/").skip(1) {
            let name = piece.split(')').next().unwrap_or_default();
            self.pictures.push(PathBuf::from("data").join(name));
        }
        text.replace("](../data/", "](data/")
    }
}

fn shown(answer: &Answer) -> String {
    let escaped = |text: &str| text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    let mut html = String::new();
    if !answer.text.trim().is_empty() {
        // An empty line would end the block.
        let lines: Vec<String> = answer.text.trim_end().lines().map(|line| format!("{} ", escaped(line))).collect();
        html += &format!("\n<pre class=\"answer\">{}</pre>\n", lines.join("\n").replace("\n \n", "\n&nbsp;\n"));
    }
    for picture in &answer.shown {
        html += &format!("\n<figure class=\"answer\">{}</figure>\n", picture.replace('\n', " "));
    }
    html
}

/// Replaces what stands between dollar signs, outside code, by MathML.
fn formulas(text: &str) -> anyhow::Result<String> {
    let mut out = String::new();
    let mut rest = text;
    let mut line_start = true;
    while let Some(next) = rest.chars().next() {
        // Code is copied: a block up to its closing fence, a span up to the same number of backticks.
        if next == '`' {
            let ticks = rest.len() - rest.trim_start_matches('`').len();
            let fence = &rest[..ticks];
            let closing = if line_start && ticks >= 3 { format!("\n{fence}") } else { fence.to_string() };
            let end = rest[ticks..].find(&closing).map_or(rest.len(), |end| ticks + end + closing.len());
            out += &rest[..end];
            rest = &rest[end..];
            line_start = false;
            continue;
        }
        if let Some(after) = rest.strip_prefix("\\$") {
            out.push('$');
            rest = after;
        } else if let Some(after) = rest.strip_prefix("$$")
            && let Some(end) = after.find("$$")
        {
            out += &mathml(&after[..end], DisplayMode::Block)?;
            rest = &after[end + 2..];
        } else if let Some(after) = rest.strip_prefix('$')
            && let Some(end) = after.find('$')
            && !after[..end].contains("\n\n")
        {
            out += &mathml(&after[..end], DisplayMode::Inline)?;
            rest = &after[end + 1..];
        } else {
            out.push(next);
            rest = &rest[next.len_utf8()..];
        }
        line_start = next == '\n';
    }
    Ok(out)
}

fn mathml(latex: &str, display_mode: DisplayMode) -> anyhow::Result<String> {
    let storage = Storage::new();
    let config = RenderConfig { display_mode, ..RenderConfig::default() };
    let events = Parser::new(latex, &storage).collect::<Result<Vec<_>, _>>();
    let events = events.map_err(|error| anyhow::anyhow!("formula `{latex}`: {error}"))?;
    let mut html = String::new();
    push_mathml(&mut html, events.into_iter().map(Ok::<_, std::convert::Infallible>), config)?;
    // The renderer escapes the entity that it writes for a space (`\ `), and leaves out a space between two attributes of `\big(`, so
    // that the bracket would be no tag. What has a meaning in Markdown is escaped: two tildes, for example, would strike out the text
    // between them.
    let escapes = [
        ("&amp;nbsp;", "&#160;"),
        ("\"minsize", "\" minsize"),
        ("~", "&#126;"),
        ("*", "&#42;"),
        ("_", "&#95;"),
        ("\n", " "),
    ];
    Ok(escapes.into_iter().fold(html, |html, (mark, escaped)| html.replace(mark, escaped)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_become_mathml_and_code_stays() {
        let page = formulas("Let $x_t$ be, `$code$`, \\$5.\n```sh\n$HOME\n```\n$$y = x^2$$\n").expect("formulas");
        assert!(page.contains("<math") && page.contains("`$code$`") && page.contains("$HOME") && page.contains("$5."));
        assert_eq!(page.matches("<math").count(), 2);
        assert!(formulas("$\\frac{1$").is_err(), "a formula that is not closed");
        let tildes = formulas("$\\tilde a + \\tilde b$").expect("a formula");
        assert!(!tildes.contains('~') && tildes.contains("&#126;"), "{tildes}");
        let space = formulas("$a,\\ b$").expect("a formula");
        assert!(!space.contains("nbsp") && space.contains("&#160;"), "{space}");
        let bracket = formulas("$\\big( a \\Big]$").expect("a formula");
        assert_eq!(bracket.matches("\" minsize=").count(), 2, "{bracket}");
    }

    #[test]
    fn answers_stand_after_their_cells() {
        let chapter = Chapter::parse("x", "# X\n```rust\n1 + 1\n```\n![a](../data/a.svg)\n").expect("a chapter");
        let answer = Answer { text: "a < b\n\nc".into(), shown: vec!["<svg>\n</svg>".into()] };
        let page = Page::new(&chapter, &[answer]).expect("a page");
        assert!(page.content.contains("a &lt; b") && page.content.contains("<figure class=\"answer\"><svg> </svg>"));
        assert!(!page.content.contains("a &lt; b \n\nc"), "no empty line within a block");
        assert_eq!(page.pictures, [PathBuf::from("data/a.svg")]);
    }
}
