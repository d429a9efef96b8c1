//! A process that follows the leading one.

use std::sync::mpsc::RecvTimeoutError;

use picofarm_model::{
    ModelError,
    train::group::{Member, Next, share},
};
use tracing::info;

use super::{ASK, MOST, Members, Role, WaitResult, failed};
use crate::{link::LinkEvent, message::Message};

impl Members<'_> {
    /// On another process, waits for a message of the leading one.
    pub(super) fn next_message(&mut self) -> WaitResult {
        let Role::Follows { link, said } = &mut self.role else {
            return WaitResult::Lost;
        };
        if let Some((message, payload)) = said.take() {
            return WaitResult::Message(message, payload);
        }
        loop {
            match self.events.recv_timeout(ASK) {
                Ok((id, _)) if id != link.id => {}
                Ok((_, LinkEvent::Message(message, payload))) => {
                    return WaitResult::Message(message, payload);
                }
                Ok((_, LinkEvent::Lost)) => {
                    self.role = Role::None;
                    return WaitResult::Lost;
                }
                Err(RecvTimeoutError::Timeout) if (self.stopped)() => return WaitResult::Stop,
                Err(_) => {}
            }
        }
    }

    /// Stores a message of the leading process for [`Group::agree`].
    pub(super) fn put_back(&mut self, message: Message, payload: Vec<u8>) {
        if let Role::Follows { said, .. } = &mut self.role {
            *said = Some((message, payload));
        }
    }

    /// On another process, handles a message of the leading one. Returns `None` to wait for the
    /// next message.
    pub(super) fn follow(&mut self, member: &mut dyn Member) -> Result<Option<Next>, ModelError> {
        let (message, payload) = match self.next_message() {
            WaitResult::Message(message, payload) => (message, payload),
            WaitResult::Lost => return Ok(None),
            WaitResult::Stop => return Ok(Some(Next::Stop)),
        };
        let answer = |role: &Role, message: Message, payload: &[u8]| {
            if let Role::Follows { link, .. } = role {
                link.say(&message, payload);
            }
        };
        match message {
            Message::Where => {
                self.mesh = None;
                answer(&self.role, Message::Stands(member.standing()), &[]);
            }
            Message::SendState => answer(&self.role, Message::State, &member.state()),
            Message::State => member.become_state(&payload)?,
            Message::Over => return Ok(Some(Next::Over)),
            Message::Form {
                generation,
                rank,
                members,
            } => {
                if rank == 0 || rank >= members.len() || members.len() > MOST {
                    return Err(failed("the leading process gave a rank that there is not"));
                }
                self.generation = generation;
                let n = members.len();
                match self.connect(rank, &members) {
                    Ok(mesh) => {
                        self.mesh = Some(mesh);
                        answer(&self.role, Message::Formed { generation }, &[]);
                        return Ok(Some(Next::Train {
                            share: share(self.batches, rank, n),
                            leads: false,
                        }));
                    }
                    Err(error) => {
                        info!(%error, "not connected with all processes of the training");
                        answer(&self.role, Message::Failed { generation }, &[]);
                    }
                }
            }
            // A message of a previous agreement.
            _ => {}
        }
        Ok(None)
    }
}
